"""Velocity fields of flows, and how they fade to zero at the faces of a box."""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive
from dnerf.nn.encodings import SinusoidalEncoding, TimeEncoding
from dnerf.nn.mlp import MLP
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
        dtype = positions.dtype
        # From the faces, in units of the fading layer.
        depth = ((self.reach.to(dtype) - (positions - self.center.to(dtype)).abs()) * self.slope.to(dtype)).clamp(0, 1)
        steps = depth ** len(self.coefficients) * _polynomial(depth, self.coefficients)
        # Not `prod`, whose backward pass asks the device for zeros.
        x, y, z = steps.split(1, dim=-1)
        return x * y * z

    def inside(self, positions: Tensor) -> Tensor:
        """Positions (..., 3) moved into the box: where the factor is 0, fields are evaluated at its faces, so that no
        product overflows for points however far."""
        center, reach = self.center.to(positions.dtype), self.reach.to(positions.dtype)
        return positions.clamp(center - reach, center + reach)


def smooth_step_coefficients(smoothness: int) -> list[float]:
    """Coefficients c_k of the polynomial x^(n+1) sum_k c_k x^k that rises from 0 to 1 with n derivatives zero at both.

    `c_k = (-1)^k C(n + k, k) C(2 n + 1, n - k)` (the regularised incomplete beta function of n + 1, n + 1).
    """
    n = smoothness
    return [(-1.0) ** k * math.comb(n + k, k) * math.comb(2 * n + 1, n - k) for k in range(n + 1)]


def _polynomial(x: Tensor, coefficients: Sequence[float]) -> Tensor:
    value = torch.full_like(x, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        value = value * x + c
    return value


class NetworkVelocity(Velocity):
    """v(x, t) = w(x) MLP(x, t), w the window of the box; zero everywhere at initialisation.

    Where a solver looks several times at the same times (`at`), those are encoded once.

    Args:
        box: (2, 3) corners outside of which nothing moves, in world units.
        num_layers: hidden layers, >= 1.
        hidden_features: their width.
        position_frequencies: octaves of the positions' encoding.
        time_frequencies: octaves of the times' encoding.
        activation: of the hidden layers; "silu" is smooth, so that solvers keep their order, "relu" is cheaper.
        fade, smoothness: see `BoxWindow`.
        window_end: fraction of training at which all octaves of position are in, see `SinusoidalEncoding`.
        time_embeddings: learnt embeddings of time, half as many as frames at most (`TimeEncoding`); 0 for none.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], num_layers: int = 3, hidden_features: int = 64, *,
        position_frequencies: int = 3, time_frequencies: int = 5, activation: str = "silu", fade: float = 0.1,
        smoothness: int = 4, window_end: float | None = None, time_embeddings: int = 0,
    ) -> None:  # fmt: skip
        super().__init__()
        check_positive("num_layers", num_layers)
        self.window = BoxWindow(box, fade, smoothness)
        self.encode_positions = SinusoidalEncoding(3, position_frequencies, window_end=window_end)
        self.encode_times = TimeEncoding(time_frequencies, time_embeddings)
        self.mlp = MLP(
            self.encode_positions.out_features + self.encode_times.out_features, hidden_features, num_layers,
            out_features=3, zero_output=True, activation=activation,
        )  # fmt: skip

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3) at positions (..., 3) and times (...,)."""
        return self.at(times)(positions)

    def parameter_groups(self) -> list[ParameterGroup]:
        """The last layer in "deformation_output", the rest in "deformation"."""
        return network_groups(self, "deformation", self.mlp.output)

    def at(self, times: Tensor) -> Callable[[Tensor], Tensor]:
        """The field at fixed times."""
        of_times = self.encode_times(times[..., None])

        def velocity(positions: Tensor) -> Tensor:
            inside = self.window.inside(positions)
            inputs = torch.cat([*self.encode_positions.parts(inside), of_times], dim=-1)
            motion = self.mlp(inputs).to(positions.dtype)
            return self.window(positions) * motion

        return velocity
