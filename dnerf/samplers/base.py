"""What a sampler is: it decides where along the rays a field is evaluated."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from dnerf.cameras import Camera
from dnerf.fields.base import RadianceField
from dnerf.kernels import MarchGrid
from dnerf.rays import Rays, Samples


class Sampler(nn.Module, ABC):
    """Places samples along rays. Training mode may place them at random, evaluation mode never does."""

    observed: tuple[str, ...] = ()  # buffers that `observe` raises; processes that train together take their maximum
    update_every: int = 1  # steps between updates that look at them

    @abstractmethod
    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        """Samples along R rays, dense or packed; no gradient flows to where they lie.

        Args:
            rays: R rays.
            field: the field that will be rendered; samplers that look where matter is ask it.
            generator: source of randomness in training mode.
        """

    def first(self, rays: Rays, most: int) -> Samples | None:
        """In evaluation mode, the first samples of each of R rays, for those who look front to back.

        Args:
            rays: R rays.
            most: samples of a ray.

        Returns:
            Packed samples; what `forward` places from the end of a ray's last one on is what would have followed. None
            from a sampler that cannot tell the first without the others (unless overridden).
        """
        return None

    def refined(
        self, samples: Samples, rays: Rays, field: RadianceField, transmittance: Tensor, min_weight: float
    ) -> Samples:
        """In evaluation mode, where the field is asked for what is seen of the samples that `first` placed.

        Args:
            samples: packed samples of R rays.
            rays: R rays.
            field: which is rendered.
            transmittance: (R,) before each ray's first sample.
            min_weight: what has less of a share in the picture may be left out.

        Returns:
            Packed samples of the same rays, in the same intervals; those themselves unless overridden.
        """
        return samples

    def seen_pixels(self, camera: Camera, time: float) -> Tensor | None:
        """Pixels of a view in whose rays this sampler may place samples in evaluation mode; all unless overridden.

        Args:
            camera: the view, on the sampler's device.
            time: of the frame, in [0, 1].

        Returns:
            Their numbers (P,) int64, `row * width + column`, in order; None for all.
        """
        return None

    def grid_at(self, time: float, dtype: torch.dtype) -> MarchGrid | None:
        """The cells of which evaluation mode keeps the intervals of `march`; None unless overridden.

        Args:
            time: of all rays, in [0, 1].
            dtype: of the rays, in which a time may round to another slab.
        """
        return None

    @property
    def share(self) -> float:
        """Share of space, averaged over time, in which pictures have samples; 1 unless known to be less."""
        return 1.0

    def places(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor] | None:
        """Random places where matter may be, evenly spread over all of them; None if this sampler does not know.

        Args:
            count: of places.
            generator: of the randomness, on the sampler's device.

        Returns:
            positions (count, 3) in world units and times (count,) in [0, 1].
        """
        return None

    def update(self, field: RadianceField, step: int) -> None:
        """Learn from the field between training steps; does nothing unless overridden.

        Args:
            field: the field in training.
            step: number of training steps done so far.
        """

    def observe(self, positions: Tensor, times: Tensor, density: Tensor) -> None:
        """Learn from what the field said at the samples of a training step; does nothing unless overridden.

        Args:
            positions: (..., 3) of the samples, in world units.
            times: (...,) of the samples.
            density: (...,) that the field said there.
        """
