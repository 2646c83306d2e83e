"""Velocity as a small network of position and time."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from dnerf.checks import check_positive
from dnerf.deformations.velocities.base import BoxWindow, Velocity
from dnerf.encodings import SinusoidalEncoding
from dnerf.mlp import ACTIVATIONS, MLP, dense_layers


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
        margin: see `BoxWindow`.
        smoothness: see `BoxWindow`.
        window_end: fraction of training at which all octaves of position are in, see `SinusoidalEncoding`.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self,
        box: Sequence[Sequence[float]],
        num_layers: int = 3,
        hidden_features: int = 64,
        *,
        position_frequencies: int = 3,
        time_frequencies: int = 5,
        activation: str = "silu",
        margin: float = 0.1,
        smoothness: int = 4,
        window_end: float | None = None,
    ) -> None:
        super().__init__()
        check_positive("num_layers", num_layers)
        self.window = BoxWindow(box, margin, smoothness)
        self.encode_positions = SinusoidalEncoding(3, position_frequencies, window_end=window_end)
        self.encode_times = SinusoidalEncoding(1, time_frequencies)
        self.from_positions = nn.Linear(self.encode_positions.out_features, hidden_features, bias=False)
        self.from_times = nn.Linear(self.encode_times.out_features, hidden_features)
        # As one layer of both inputs would start.
        bound = math.sqrt(6 / (self.encode_positions.out_features + self.encode_times.out_features))
        for layer in (self.from_positions, self.from_times):
            nn.init.uniform_(layer.weight, -bound, bound)
        nn.init.zeros_(self.from_times.bias)
        self.mlp = MLP(
            hidden_features,
            hidden_features,
            num_layers - 1,
            out_features=3,
            zero_output=True,
            activation=activation,
        )
        self.activation = ACTIVATIONS[activation]

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3) at positions (..., 3) and times (...,)."""
        return self.at(times)(positions)

    def at(self, times: Tensor) -> Callable[[Tensor], Tensor]:
        """The field at fixed times."""
        of_times = self.encode_times(times[..., None])
        weight, bias = torch.cat([self.from_positions.weight, self.from_times.weight], dim=-1), self.from_times.bias

        def velocity(positions: Tensor) -> Tensor:
            inside = self.window.inside(positions)
            inputs = torch.cat([*self.encode_positions.parts(inside), of_times], dim=-1)
            hidden = dense_layers(inputs, [weight], [bias], self.activation)
            return self.window(positions) * self.mlp(hidden).to(positions.dtype)

        return velocity
