"""What a velocity field is, and how it fades to zero at the faces of a box."""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive
from dnerf.nn.parameter_groups import DeclaresGroups, ParameterGroup, network_groups


class Velocity(nn.Module, DeclaresGroups):
    """Velocity in world units per unit of time."""

    @abstractmethod
    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3) at positions (..., 3) and times (...,), in the dtype of the positions."""

    def parameter_groups(self) -> list[ParameterGroup]:
        """All in "deformation", as of any deformation."""
        return network_groups(self, "deformation")

    def at(self, times: Tensor) -> Callable[[Tensor], Tensor]:
        """The field at fixed times (...,) as a function of positions (..., 3), for several looks at the same times.

        A field that can do part of its work once for all of them overrides this.
        """
        return lambda positions: self(positions, times)


class BoxWindow(nn.Module):
    """A factor that is 1 well inside a box and 0 on its faces and outside: a product of one smooth step per axis.

    Args:
        box: (2, 3) lowest and highest corner, in world units.
        fade: width of the fading layer at each face, as a fraction of half the side, in (0, 1].
        smoothness: number of continuous derivatives, 0 to 4; a solver of order p keeps its order with p.

    Raises:
        ValueError: for a box that is none or numbers out of range.
    """

    def __init__(self, box: Sequence[Sequence[float]], fade: float = 0.1, smoothness: int = 4) -> None:
        super().__init__()
        check_positive("fade", fade)
        if fade > 1 or smoothness not in range(5):
            raise ValueError(f"fade must be in (0, 1] and smoothness in 0..4, got {fade} and {smoothness}")
        corners = as_box(box)
        self.coefficients = smooth_step_coefficients(smoothness)
        self.center = nn.Buffer(corners.mean(0), persistent=False)
        self.reach = nn.Buffer(0.5 * (corners[1] - corners[0]), persistent=False)
        self.slope = nn.Buffer(1 / (fade * self.reach), persistent=False)

    def forward(self, positions: Tensor) -> Tensor:
        """Factor (..., 1) at positions (..., 3)."""
        # Not `prod`, whose backward pass asks the device for zeros.
        x, y, z = self._steps(self._depth(positions)).split(1, dim=-1)
        return x * y * z

    def inside(self, positions: Tensor) -> Tensor:
        """Positions (..., 3) moved into the box: where the factor is 0, fields are evaluated at its faces, so that no
        product overflows for points however far."""
        center, reach = self.center.to(positions.dtype), self.reach.to(positions.dtype)
        return positions.clamp(center - reach, center + reach)

    def value_and_gradient(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Factor (..., 1) and its gradient (..., 3) to the position, differentiable both."""
        depth = self._depth(positions)
        x, y, z = self._steps(depth).unbind(-1)
        inside = ((depth > 0) & (depth < 1)).to(depth.dtype)
        slopes = -torch.sign(positions - self.center.to(positions.dtype)) * self.slope.to(positions.dtype) * inside
        along = self._step_slopes(depth) * slopes
        others = torch.stack([y * z, x * z, x * y], dim=-1)
        return (x * y * z)[..., None], along * others

    def _depth(self, positions: Tensor) -> Tensor:
        """Distance from the faces in units of the fading layer, clamped to [0, 1]; (..., 3)."""
        dtype = positions.dtype
        return ((self.reach.to(dtype) - (positions - self.center.to(dtype)).abs()) * self.slope.to(dtype)).clamp(0, 1)

    def _steps(self, depth: Tensor) -> Tensor:
        return depth ** (len(self.coefficients)) * _horner(depth, self.coefficients)

    def _step_slopes(self, depth: Tensor) -> Tensor:
        first = len(self.coefficients)
        scaled = [c * (first + k) for k, c in enumerate(self.coefficients)]
        return depth ** (first - 1) * _horner(depth, scaled)


def smooth_step_coefficients(smoothness: int) -> list[float]:
    """Coefficients c_k of the polynomial x^(n+1) sum_k c_k x^k that rises from 0 to 1 with n derivatives zero at both.

    `c_k = (-1)^k C(n + k, k) C(2 n + 1, n - k)` (the regularised incomplete beta function of n + 1, n + 1).
    """
    n = smoothness
    return [(-1.0) ** k * math.comb(n + k, k) * math.comb(2 * n + 1, n - k) for k in range(n + 1)]


def _horner(x: Tensor, coefficients: Sequence[float]) -> Tensor:
    value = torch.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        value = value * x + c
    return value
