"""Velocity without divergence: the curl of a potential, so that the flow keeps every volume."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_positive
from dnerf.deformations.velocities.base import BoxWindow, Velocity
from dnerf.nn.encodings import SinusoidalEncoding
from dnerf.nn.mlp import MLP


class CurlVelocity(Velocity):
    """v = curl(w(x) A(x, t)) with the potential A = sum_k a_k(t) sin(k_k . x + b_k) and the window w of the box.

    In closed form `v = sum_k cos(k_k . x + b_k) w (k_k x a_k) + grad w x A`: free of divergence to rounding and zero
    outside the box, since the potential is windowed, not the velocity. The waves are learnt; their amplitudes are a
    small network of time, zero at initialisation. (FreeGave (2025) keeps volumes by a basis as well.)

    Args:
        box: (2, 3) corners outside of which nothing moves, in world units.
        num_waves: K.
        hidden_features: width of the time network's two hidden layers.
        time_frequencies: octaves of the times' encoding.
        max_wavenumber: spread (standard deviation per axis) of the waves at initialisation, in radians per world unit.
        fade, smoothness: see `BoxWindow`; the velocity has one continuous derivative less than the window.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], num_waves: int = 64, hidden_features: int = 64, *,
        time_frequencies: int = 5, max_wavenumber: float = 3.0, fade: float = 0.2, smoothness: int = 4,
    ) -> None:  # fmt: skip
        super().__init__()
        check_positive("num_waves", num_waves)
        check_positive("max_wavenumber", max_wavenumber)
        self.window = BoxWindow(box, fade, smoothness)
        self.wavevectors = nn.Parameter(max_wavenumber * torch.randn(num_waves, 3))
        self.phases = nn.Parameter(2 * torch.pi * torch.rand(num_waves))
        self.encode_times = SinusoidalEncoding(1, time_frequencies)
        self.amplitudes = MLP(
            self.encode_times.out_features, hidden_features, 2, out_features=3 * num_waves, zero_output=True,
            activation="silu",
        )  # fmt: skip

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3) at positions (..., 3) and times (...,)."""
        amplitudes = self.amplitudes(self.encode_times(times[..., None])).to(positions.dtype)
        amplitudes = amplitudes.unflatten(-1, (-1, 3))
        # Elementwise sums rather than products of matrices, which autocast would run in bfloat16.
        angles = (self.window.inside(positions)[..., None, :] * self.wavevectors).sum(-1) + self.phases
        turned = torch.linalg.cross(self.wavevectors.expand(amplitudes.shape), amplitudes)
        potential = (torch.sin(angles)[..., None] * amplitudes).sum(-2)
        curl = (torch.cos(angles)[..., None] * turned).sum(-2)
        value, gradient = self.window.value_and_gradient(positions)
        return value * curl + torch.linalg.cross(gradient, potential)
