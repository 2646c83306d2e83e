"""What a sampler is: it decides where along the rays a field is evaluated."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from dnerf.cameras import Camera
from dnerf.compositing import FieldOutput
from dnerf.fields.base import RadianceField, ask_along
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
    ) -> tuple[Samples, FieldOutput]:
        """In evaluation mode, where the field is asked for what is seen of the samples that `first` placed.

        Args:
            samples: packed samples of R rays.
            rays: R rays.
            field: which is rendered.
            transmittance: (R,) before each ray's first sample.
            min_weight: what has less of a share in the picture may be left out.

        Returns:
            Packed samples of the same rays, in the same intervals, and what the field says there, without extras;
            those themselves unless overridden.
        """
        assert samples.ray_indices is not None
        return samples, ask_along(field, rays, samples.ray_indices, samples.distances)

    def seen_rays(self, camera: Camera, time: float) -> tuple[Tensor, Rays] | None:
        """Pixels of a view in whose rays this sampler may place samples in evaluation mode; all unless overridden.

        Args:
            camera: the view, on the sampler's device.
            time: of the frame, in [0, 1].

        Returns:
            Their numbers (P,) int64, `row * width + column`, in order, and their rays, which may be cut short where
            they meet nothing, by whole intervals; None for all of them.
        """
        return None

    def grid_at(self, time: float, dtype: torch.dtype) -> MarchGrid | None:
        """The cells of which evaluation mode keeps the intervals of `march`; None unless overridden.

        Args:
            time: of all rays, in [0, 1].
            dtype: of the rays, in which a time may round to another slab.
        """
        return None

    def to_size(
        self,
        rays: Rays,
        field: RadianceField,
        marched: int,
        kept: int,
        *,
        min_weight: float,
        generator: torch.Generator | None = None,
    ) -> tuple[Samples, Tensor]:
        """Samples in a fixed number of places, found without waiting for a device. Not every sampler can.

        Rays that do not fit get none: they show the background, and train nothing.

        Args:
            rays: R rays.
            field: which is asked for densities.
            marched: places for intervals that may hold something.
            kept: places for samples.
            min_weight: in the picture, up to which intervals are left out; 0 for none.
            generator: source of randomness in training mode.

        Returns:
            Packed samples, `kept` of them, some of length zero; and how many places of either kind were wanted, (2,).

        Raises:
            ValueError: if this sampler cannot (unless overridden).
        """
        raise ValueError(f"{type(self).__name__} cannot place samples in a fixed number of places")

    def fix_sizes(self, marched: int | None, kept: int | None = None) -> None:
        """In training, place samples by `to_size` from now on, in so many places; None for no more.

        Raises:
            ValueError: if this sampler cannot (unless overridden).
        """
        if marched is not None:
            raise ValueError(f"{type(self).__name__} cannot place samples in a fixed number of places")

    def fullness(self) -> float:
        """The larger share of its fixed places that the last training batch wanted; above 1, some rays went without."""
        raise ValueError(f"{type(self).__name__} has no fixed number of places")

    @property
    def settings(self) -> tuple[object, ...]:
        """What decides, beside tensors, how samples are placed now: when it changes, CUDA graphs are recorded anew."""
        return ()

    @property
    def share(self) -> float:
        """Share of space, averaged over time, in which pictures have samples; 1 unless known to be less."""
        return 1.0

    def cells_at_any_time(self) -> tuple[Tensor, Tensor] | None:
        """Corners (2, 3) of what this sampler keeps account of, and which of the cells (Gx, Gy, Gz) that it is cut into
        pictures look into at some time; None if it keeps none."""
        return None

    def places(self, unit: Tensor) -> tuple[Tensor, Tensor] | None:
        """Places where matter may be, evenly spread over all of them; None if this sampler does not know.

        Args:
            unit: (N, 5) numbers in [0, 1), evenly spread: which region, and the time and the position within it.

        Returns:
            positions (N, 3) in world units and times (N,) in [0, 1].
        """
        return None

    def update(self, field: RadianceField, step: int) -> None:
        """Learn from the field between training steps, if this sampler does and it is time.

        Args:
            field: the field in training.
            step: number of training steps done so far.
        """
        probes = self.probes(step)
        if probes is not None:
            self.learn(field, probes)

    def probes(self, step: int) -> Tensor | None:
        """Random numbers (N, K) for `learn`, or None if nothing is to be learnt after so many steps."""
        return None

    def learn(self, field: RadianceField, probes: Tensor) -> None:
        """Learn from the field at random places; does nothing, and waits for no device, unless overridden.

        Args:
            field: the field in training.
            probes: from `probes`.
        """

    def observe(self, positions: Tensor, times: Tensor, density: Tensor) -> None:
        """Learn from what the field said at the samples of a training step; does nothing unless overridden.

        Args:
            positions: (..., 3) of the samples, in world units.
            times: (...,) of the samples.
            density: (...,) that the field said there.
        """
