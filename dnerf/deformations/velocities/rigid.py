"""Velocity biased to rigid motion: a few bodies that turn and travel, softly blended."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive
from dnerf.deformations.velocities.base import BoxWindow, Velocity
from dnerf.nn.encodings import SinusoidalEncoding
from dnerf.nn.mlp import MLP


class RigidVelocity(Velocity):
    """v(x, t) = w(x) sum_c s_c(x, t) (omega_c(t) x (x - p_c(t)) + u_c(t)).

    Each cluster c has a twist (turning omega, travelling u) and a centre p that change with time; the shares s are a
    softmax of -|x - p_c|^2 / (2 r_c^2). One cluster moves everything as one rigid body. Zero at initialisation.

    Args:
        box: (2, 3) corners outside of which nothing moves, in world units.
        num_clusters: C.
        hidden_features: width of the time network's two hidden layers.
        time_frequencies: octaves of the times' encoding.
        radius: r_c at initialisation, in world units; a quarter of the box's shortest side if None.
        fade, smoothness: see `BoxWindow`.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], num_clusters: int = 16, hidden_features: int = 64, *,
        time_frequencies: int = 5, radius: float | None = None, fade: float = 0.1, smoothness: int = 4,
    ) -> None:  # fmt: skip
        super().__init__()
        check_positive("num_clusters", num_clusters)
        self.window = BoxWindow(box, fade, smoothness)
        corners = as_box(box)
        radius = 0.25 * float((corners[1] - corners[0]).min()) if radius is None else radius
        check_positive("radius", radius)
        self.centers = nn.Parameter(torch.lerp(corners[0], corners[1], 0.25 + 0.5 * torch.rand(num_clusters, 3)))
        self.log_radii = nn.Parameter(torch.full((num_clusters,), radius).log())
        self.encode_times = SinusoidalEncoding(1, time_frequencies)
        self.motions = MLP(
            self.encode_times.out_features, hidden_features, 2, out_features=9 * num_clusters, zero_output=True,
            activation="silu",
        )  # fmt: skip

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3) at positions (..., 3) and times (...,)."""
        motions = self.motions(self.encode_times(times[..., None])).to(positions.dtype).unflatten(-1, (-1, 9))
        turning, travelling, shift = motions.split(3, dim=-1)
        arms = self.window.inside(positions)[..., None, :] - (self.centers + shift)
        shares = torch.softmax(-0.5 * arms.square().sum(-1) * torch.exp(-2 * self.log_radii), dim=-1)
        blended = (shares[..., None] * (torch.linalg.cross(turning, arms) + travelling)).sum(-2)
        return self.window(positions) * blended
