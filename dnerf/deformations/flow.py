"""Neural-ODE flow: a velocity field carries points between any time and the canonical one (Chen et al. 2018)."""

from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_choice, check_positive
from dnerf.deformations.base import InvertibleDeformation, check_positions_times
from dnerf.deformations.inversion import attach_gradient, invert
from dnerf.deformations.solvers import RightHandSide, Solver, failure
from dnerf.deformations.velocities import Velocity

IN_TIME = ("varying", "stationary")


class FlowDeformation(InvertibleDeformation):
    """The flow of a velocity field: one differential equation for samples that each have their own time.

    - `velocity_in_time="varying"`: points move with v, so x(t0) solves `dx/dtau = v(x, tau)` from tau = t to t0,
      written as `dx/ds = (t0 - t) v(x, t + s (t0 - t))`, s in [0, 1]. v is the physical velocity; it can be
      extrapolated in time.
    - `velocity_in_time="stationary"`: `dx/ds = (t0 - t) v(x, t)`, the exponential of the field of the sample's own time
      (log-domain diffeomorphisms: Arsigny et al. 2006, Ashburner 2007). As invertible, and the same where v does not
      depend on time, but errors do not add up over long times and few steps suffice: with one Euler step it is D-NeRF's
      displacement. v is not the physical velocity. With `canonical_time=None` the factor is 1: no time is canonical.

    Both are the identity at initialisation if v is zero, both compose: motion from t to t' is
    `inverse(forward(x, t), t')`.

    The exact flow never folds space. Steps of length h keep the Jacobian determinant positive while the norm of the
    velocity's gradient stays below 1 / h (Euler) or (sqrt(3) - 1) / h (midpoint), h times |t0 - t| where there is a
    canonical time; `dnerf.losses.JacobianDeterminantLoss` keeps it positive in training.

    Args:
        velocity: the field, zero outside the scene's box.
        canonical_time: t0, or None (stationary velocity only).
        velocity_in_time: "varying" or "stationary".
        solver: name, see `Solver`.
        num_steps: of a fixed-step solver.
        rtol, atol, max_steps: of an adaptive solver, see `Solver`.
        corrections: round trips by which `inverse` is made the inverse of the *discretised* `forward` (see `invert`):
            the equation solved backwards, which 0 leaves as it is, misses it by both solves' errors.

    Raises:
        ValueError: for settings out of range, or a varying velocity without a canonical time.
    """

    def __init__(
        self, velocity: Velocity, canonical_time: float | None = 0.0, *, velocity_in_time: str = "varying",
        solver: str = "rk4", num_steps: int = 8, rtol: float = 1e-5, atol: float = 1e-6, max_steps: int = 1000,
        corrections: int = 10,
    ) -> None:  # fmt: skip
        super().__init__()
        check_choice("velocity_in_time", velocity_in_time, IN_TIME)
        check_positive("corrections", corrections, allow_zero=True)
        if canonical_time is None and velocity_in_time == "varying":
            raise ValueError("canonical_time must be a time in [0, 1] for a varying velocity, got None")
        if canonical_time is not None and not 0 <= canonical_time <= 1:
            raise ValueError(f"canonical_time must be in [0, 1] or None, got {canonical_time}")
        self.velocity = velocity
        self.canonical_time = canonical_time
        self.velocity_in_time = velocity_in_time
        self.solver = Solver(solver, num_steps, rtol=rtol, atol=atol, max_steps=max_steps)
        self.corrections = corrections

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of world positions (..., 3) at times (...,).

        Raises:
            IntegrationError: where the solver fails or positions become infinite.
        """
        return self._solve(positions, times, backwards=False)

    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """World positions (..., 3) at times (...,) of canonical positions (..., 3); raises as `forward`."""
        if not self.corrections or not canonical.numel():
            return self.reverse(canonical, times)

        # There and back is nearly the identity, so the fixed-point iteration begins close to its end.
        def round_trip(target: Tensor, times: Tensor) -> Tensor:
            return self(self.reverse(target, times), times)

        with torch.no_grad():
            # The first evaluation only measures the guess.
            target, _ = invert(round_trip, canonical, times, num_iterations=self.corrections + 1)
            world = self.reverse(target, times)
        trained = any(parameter.requires_grad for parameter in self.parameters())
        if torch.is_grad_enabled() and (trained or canonical.requires_grad or times.requires_grad):
            return attach_gradient(self, world, canonical, times)
        return world

    def reverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """The equation solved backwards in the same steps: `inverse` without corrections."""
        return self._solve(canonical, times, backwards=True)

    def _solve(self, positions: Tensor, times: Tensor, *, backwards: bool) -> Tensor:
        check_positions_times(positions, times)
        if not positions.numel():
            return positions
        start, end, spans = self._spans(times, backwards)
        right_hand_side = self._right_hand_side(start, spans)
        reached: tuple[float, Tensor] = (0.0, positions)

        def watched(s: float | Tensor, x: Tensor) -> Tensor:
            nonlocal reached
            if self.solver.is_adaptive:
                reached = (float(torch.as_tensor(s).detach()), x.detach())
            return right_hand_side(s, x)

        problem = "positions are not finite"
        try:
            result = self.solver.solve(watched, positions)
            # A graph that is recorded reads nothing; what is not finite then shows in the loss.
            if _is_recorded(result) or bool(torch.isfinite(result).all()):
                return result
        except AssertionError as error:
            problem = f"the solver stopped ({error})"
        raise failure(self.solver, problem, right_hand_side, reached, start, end) from None

    def _spans(self, times: Tensor, backwards: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Time at s = 0 and at s = 1, and the signed length of the way, (...,) each."""
        if self.canonical_time is None:
            length = torch.full_like(times, -1.0 if backwards else 1.0)
            return times, times, length
        canonical = torch.full_like(times, self.canonical_time)
        start, end = (canonical, times) if backwards else (times, canonical)
        return (times, times, end - start) if self.velocity_in_time == "stationary" else (start, end, end - start)

    def _right_hand_side(self, start: Tensor, spans: Tensor) -> RightHandSide:
        column = spans[..., None]
        if self.velocity_in_time == "stationary":
            field = self.velocity.at(start)
            return lambda s, positions: column * field(positions)
        return lambda s, positions: column * self.velocity(positions, start + s * spans)


def _is_recorded(values: Tensor) -> bool:
    return values.is_cuda and torch.cuda.is_current_stream_capturing()


class FlowChain(InvertibleDeformation):
    """Flows one after the other, each from where the one before ended.

    With stationary velocities it is one flow whose velocity is another in each part of the way, as in registration with
    large deformations (Beg et al. 2005): it reaches maps that are not the exponential of one stationary field. Where
    each takes one Euler step they are residual blocks, invertible while each keeps to its own bound (`FlowDeformation`;
    Behrmann et al. 2019), so a chain bends more than one flow before it folds: determinants multiply.

    Args:
        flows: by name, in the order in which world positions meet them.

    Raises:
        ValueError: if there is none, or something else than a flow.
    """

    def __init__(self, flows: Mapping[str, FlowDeformation]) -> None:
        super().__init__()
        if not flows:
            raise ValueError("flows must be at least one, got none")
        for name, flow in flows.items():
            if not isinstance(flow, FlowDeformation):
                raise ValueError(f"flows must be FlowDeformation, got {type(flow).__name__} for {name}")
        self.flows = nn.ModuleDict(flows)

    def _links(self) -> list[FlowDeformation]:
        return [cast(FlowDeformation, flow) for flow in self.flows.values()]

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of world positions (..., 3) at times (...,); raises as the flows do."""
        for flow in self._links():
            positions = flow(positions, times)
        return positions

    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """World positions (..., 3) at times (...,) of canonical positions (..., 3); raises as the flows do."""
        for flow in reversed(self._links()):
            canonical = flow.inverse(canonical, times)
        return canonical

    def reverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """See `FlowDeformation.reverse`."""
        for flow in reversed(self._links()):
            canonical = flow.reverse(canonical, times)
        return canonical
