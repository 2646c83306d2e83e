"""Velocity as a small network of position and time."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from dnerf.checks import check_positive
from dnerf.deformations.velocities.base import BoxWindow, Velocity
from dnerf.encodings import SinusoidalEncoding, TimeEncoding
from dnerf.mlp import MLP


class NetworkVelocity(Velocity):
    """v(x, t) = w(x) MLP(x, t), w the window of the box; zero everywhere at initialisation.

    With `twists` the MLP gives a travelling u and a turning omega, v = w (u + k omega x (x - c)), c the box's centre:
    what turns as a rigid body has the same u and omega everywhere, which is less to learn than v. The factor k says how
    readily the field turns: steps of an optimiser move u and omega alike.

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
        twists: k in radians per unit of the MLP's output; 0 for a field that gives v itself.
        time_knots: moments of which features are learnt, half as many as frames at most (`TimeEncoding`); 0 for none.
        knot_features: how many of each.

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
        twists: float = 0.0,
        time_knots: int = 0,
        knot_features: int = 4,
    ) -> None:
        super().__init__()
        check_positive("num_layers", num_layers)
        check_positive("twists", twists, allow_zero=True)
        self.twists = float(twists)
        self.window = BoxWindow(box, margin, smoothness)
        self.encode_positions = SinusoidalEncoding(3, position_frequencies, window_end=window_end)
        self.encode_times = TimeEncoding(time_frequencies, time_knots, knot_features)
        self.mlp = MLP(
            self.encode_positions.out_features + self.encode_times.out_features,
            hidden_features,
            num_layers,
            out_features=6 if twists else 3,
            zero_output=True,
            activation=activation,
        )

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3) at positions (..., 3) and times (...,)."""
        return self.at(times)(positions)

    def at(self, times: Tensor) -> Callable[[Tensor], Tensor]:
        """The field at fixed times."""
        of_times = self.encode_times(times[..., None])

        def velocity(positions: Tensor) -> Tensor:
            inside = self.window.inside(positions)
            inputs = torch.cat([*self.encode_positions.parts(inside), of_times], dim=-1)
            motion = self.mlp(inputs).to(positions.dtype)
            if self.twists:
                travelling, turning = motion.split(3, dim=-1)
                arms = inside - self.window.center.to(positions.dtype)
                motion = torch.add(travelling, torch.linalg.cross(turning, arms), alpha=self.twists)
            return self.window(positions) * motion

        return velocity
