"""Velocity as a small network of position and time."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from dnerf.core.checks import check_positive
from dnerf.deformations.velocities.base import BoxWindow, Velocity
from dnerf.nn.encodings import SinusoidalEncoding, TimeEncoding
from dnerf.nn.mlp import MLP
from dnerf.nn.parameter_groups import ParameterGroup, network_groups


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
        embedding_features: how many of each.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], num_layers: int = 3, hidden_features: int = 64, *,
        position_frequencies: int = 3, time_frequencies: int = 5, activation: str = "silu", fade: float = 0.1,
        smoothness: int = 4, window_end: float | None = None, time_embeddings: int = 0, embedding_features: int = 4,
    ) -> None:  # fmt: skip
        super().__init__()
        check_positive("num_layers", num_layers)
        self.window = BoxWindow(box, fade, smoothness)
        self.encode_positions = SinusoidalEncoding(3, position_frequencies, window_end=window_end)
        self.encode_times = TimeEncoding(time_frequencies, time_embeddings, embedding_features)
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
