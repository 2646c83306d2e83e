"""Integration of many points at once, each over its own span of time, as one ordinary differential equation.

With `start` and `end` per point, `dx/ds = (end - start) v(x, start + s (end - start))` runs over s in [0, 1] for all.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from dnerf.core.checks import check_choice, check_positive

FIXED_SOLVERS = {"euler": 1, "midpoint": 2, "rk4": 4}
"""Evaluations per step, which is also the order of each."""

ADAPTIVE_SOLVERS = ("dopri5", "dopri8", "bosh3", "adaptive_heun")
SOLVERS = (*FIXED_SOLVERS, *ADAPTIVE_SOLVERS)

RightHandSide = Callable[[float | Tensor, Tensor], Tensor]
"""Derivative (..., 3) to s, of s (a number) and positions (..., 3)."""


class IntegrationError(ValueError):
    """A velocity field that the chosen solver cannot integrate; names the time and what to change."""


class Solver:
    """How a flow is integrated.

    Args:
        name: "euler", "midpoint" or "rk4" (3/8 rule) with `num_steps` equal steps of s, written out here and equal to
            torchdiffeq's to rounding; "dopri5", "dopri8", "bosh3" or "adaptive_heun" through torchdiffeq (whose
            fehlberg2 misses its tolerance by a factor of hundreds, and is left out).
        num_steps: of a fixed-step solver.
        rtol: relative tolerance of an adaptive one.
        atol: absolute tolerance of an adaptive one, in world units. In float32, tolerances below 1e-6 only cost.
        max_steps: of an adaptive solver, accepted and refused ones together, before it gives up.

    Raises:
        ValueError: for an unknown name, or numbers that are not positive.

    The step size of an adaptive solver is shared by all points. It is controlled by the worst point's error, not by
    torchdiffeq's mean over the batch, which would hide one hard point among ten thousand.
    """

    def __init__(
        self, name: str = "rk4", num_steps: int = 8, *, rtol: float = 1e-5, atol: float = 1e-6,
        max_steps: int = 1000,
    ) -> None:  # fmt: skip
        check_choice("solver", name, SOLVERS)
        for argument, value in (("num_steps", num_steps), ("rtol", rtol), ("atol", atol), ("max_steps", max_steps)):
            check_positive(argument, value)
        self.name, self.num_steps = name, num_steps
        self.rtol, self.atol, self.max_steps = rtol, atol, max_steps

    @property
    def is_adaptive(self) -> bool:
        """Whether the number of steps follows the tolerances."""
        return self.name in ADAPTIVE_SOLVERS

    def solve(self, right_hand_side: RightHandSide, positions: Tensor) -> Tensor:
        """Positions (..., 3) at s = 1 of those at s = 0; torchdiffeq raises AssertionError where it cannot go on.

        Gradients are those of the solver's steps.
        """
        if not self.is_adaptive:
            return fixed_steps(self.name, right_hand_side, positions, self.num_steps)
        from torchdiffeq import odeint  # with it comes scipy, a fifth of a second that fixed steps need not wait for

        # Steps end where the way ends: torchdiffeq would step past it and interpolate, to fourth order only, which is
        # all that a loose dopri8 would then be.
        options = {
            "norm": lambda values: values.square().mean(-1).amax().sqrt(),  # of the worst point
            "max_num_steps": self.max_steps, "step_t": torch.tensor([0.0, 1.0]),
        }  # fmt: skip
        interval = torch.tensor([0.0, 1.0], dtype=positions.dtype, device=positions.device)
        tolerances = {"rtol": self.rtol, "atol": self.atol}
        return odeint(right_hand_side, positions, interval, method=self.name, options=options, **tolerances)[-1]


def fixed_steps(name: str, right_hand_side: RightHandSide, positions: Tensor, num_steps: int) -> Tensor:
    """Positions at s = 1 by equal steps of an explicit Runge-Kutta rule of order 1, 2 or 4 (the 3/8 rule)."""
    step = 1 / num_steps
    for i in range(num_steps):
        positions = positions + step * _increment(name, right_hand_side, positions, i * step, step)
    return positions


def _increment(name: str, f: RightHandSide, x: Tensor, s: float, h: float) -> Tensor:
    """Mean derivative over one step from s to s + h."""
    first = f(s, x)
    if name == "euler":
        return first
    if name == "midpoint":
        return f(s + h / 2, x + (h / 2) * first)
    second = f(s + h / 3, x + (h / 3) * first)
    third = f(s + 2 * h / 3, x + h * (second - first / 3))
    fourth = f(s + h, x + h * (first - second + third))
    return (first + 3 * (second + third) + fourth) / 8


def failure(
    solver: Solver, reason: str, right_hand_side: RightHandSide, reached: tuple[float, Tensor], start: Tensor,
    end: Tensor,
) -> IntegrationError:  # fmt: skip
    """The error to raise for a failed integration, which names the worst point there and its time.

    `reached` is s and positions (..., 3): of a fixed-step solver where it began, of an adaptive one where it stopped.
    Points are on their way from times `start` to `end`, (...,) each.
    """
    s, x = reached
    with torch.no_grad():
        slope = right_hand_side(s, x)
        for i in range(0 if solver.is_adaptive else solver.num_steps):
            if not bool((torch.isfinite(slope) & torch.isfinite(x)).all()):
                break
            s = i / solver.num_steps
            x = x + _increment(solver.name, right_hand_side, x, s, 1 / solver.num_steps) / solver.num_steps
            slope = right_hand_side(s, x)
    speeds = (slope + 0 * x).reshape(-1, 3).norm(dim=-1)
    # The first point that is not finite, or the fastest.
    index = int(torch.where(torch.isfinite(speeds), speeds, torch.inf).argmax())
    remedy = "raise rtol and atol, take a fixed-step solver (rk4)"
    if not solver.is_adaptive:
        remedy = "take more steps, lower the learning rate"
    begin, finish = float(start.reshape(-1)[index]), float(end.reshape(-1)[index])
    return IntegrationError(
        f"flow: {reason} at time {begin + float(s) * (finish - begin):.4g} (point {index} of {len(speeds)}, on its way "
        f"from time {begin:.4g} to {finish:.4g} at {float(speeds[index]):.3g} world units per way) with {solver.name}; "
        f"{remedy}, or keep the velocity small and smooth"
    )
