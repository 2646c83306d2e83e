"""The renderer: rays -> sampler -> field -> composite. It is the whole trainable model."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain

import torch
from torch import Tensor, nn

from dnerf.core.backgrounds import Background, ConstantBackground
from dnerf.core.cameras import Camera
from dnerf.core.checks import check_choice, check_positive, check_within
from dnerf.core.compositing import Rendering, composite, over
from dnerf.core.quadrature import RULES
from dnerf.core.rays import Rays, Samples
from dnerf.core.schedules import Scheduled
from dnerf.core.shortcuts import speaks_for
from dnerf.fields.base import RadianceField, evaluate_samples, interval_aware
from dnerf.kernels import has_bfloat16
from dnerf.rendering.exposure import Exposure
from dnerf.rendering.frame_graphs import FrameGraphs
from dnerf.rendering.image import image_columns
from dnerf.samplers.base import Capacity, FixedCapacity, Sampler

LEAST_LIGHT = 1e-3  # a quarter of a step of eight bits, behind which a costly background is left out
PRECISIONS = {"float32": None, "bfloat16": torch.bfloat16}


def has_fixed_capacity(sampler: Sampler) -> bool:
    """Whether a sampler can fill a fixed number of places with what its `forward` places."""
    return isinstance(sampler, FixedCapacity) and speaks_for(sampler, "sample_fixed", "forward")


class Renderer(nn.Module):
    """Renders rays of a radiance field; the one module that is trained and saved.

    Args:
        field: what is rendered.
        sampler: where along rays it is evaluated.
        background: what lies behind; white if None.
        quadrature: how density between samples is read, "constant", "linear" or "parabolic": see
            `dnerf.core.quadrature`.
        graphs: on a GPU, replay whole images as CUDA graphs; for samplers of `FixedCapacity`.
        precision: "float32", or "bfloat16" to run networks under autocast where the processor has instructions for it;
            positions, encodings and compositing stay float32 either way.
        stop_transmittance: whole images end a ray of packed samples once so little light is left, which changes
            colours by at most as much, and by as much again for each interval that a sampler which subdivides leaves
            out since its weight is as small; 0 to evaluate the field everywhere. Without effect on other quadratures
            than the constant one, whose intervals do not depend on their neighbours.
        exposure: of the training images' cameras, in training mode; images show the scene without it. None for none.

    Raises:
        ValueError: for another precision or quadrature, one that reads densities at points of a field that knows
            intervals, a transmittance outside [0, 1), or graphs with a sampler that has no fixed capacity.
    """

    def __init__(
        self, field: RadianceField, sampler: Sampler, background: Background | None = None, *,
        precision: str = "float32", stop_transmittance: float = 0.0, quadrature: str = "constant", graphs: bool = False,
        exposure: Exposure | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        check_within("stop_transmittance", stop_transmittance, "[0, 1)")
        check_choice("quadrature", quadrature, RULES)
        check_choice("precision", precision, tuple(PRECISIONS))
        if quadrature != "constant" and interval_aware(field):
            raise ValueError(f"quadrature must be constant for a field that knows intervals, got {quadrature!r}")
        if graphs and not has_fixed_capacity(sampler):
            raise ValueError(f"graphs needs a sampler with a fixed capacity, got {type(sampler).__name__}")
        self.field = field
        self.sampler = sampler
        self.background = ConstantBackground("white") if background is None else background
        self.precision = precision
        self.stop_transmittance = stop_transmittance
        self.quadrature = quadrature
        self.graphs = graphs
        self.exposure = exposure
        self.generation = 0
        self._frames: FrameGraphs | None = None

    @property
    def device(self) -> torch.device:
        """Where the model lives."""
        return next(chain(self.parameters(), self.buffers())).device

    @property
    def ends_early(self) -> bool:
        """Whether images end a ray once little light is left."""
        return self.stop_transmittance > 0 and self.quadrature == "constant"

    def forward(
        self, rays: Rays, *, generator: torch.Generator | None = None, capacity: Capacity | None = None
    ) -> Rendering:
        """Render R rays; in training mode the sampler also learns from the field's output.

        With a capacity samples get a fixed number of places; ValueError if this sampler cannot keep to it.
        """
        with self.autocast(rays.origins.device):
            if capacity is None:
                samples = self.sampler(rays, self.field, generator=generator)
            elif isinstance(self.sampler, FixedCapacity) and has_fixed_capacity(self.sampler):
                samples = self.sampler.sample_fixed(rays, self.field, capacity, generator=generator)
            else:
                raise ValueError(f"{type(self.sampler).__name__} cannot place samples in a fixed number of places")
        return self.render_samples(rays, samples, self.field, generator)

    def render_samples(
        self, rays: Rays, samples: Samples, field: RadianceField, generator: torch.Generator | None = None
    ) -> Rendering:
        """Evaluate a field at samples of R rays, dense or packed, and composite."""
        with self.autocast(rays.origins.device):
            output, positions, times = evaluate_samples(field, samples, rays)
        if self.training:
            density = torch.where(samples.lengths > 0, output.density.detach(), 0)  # of padding: nothing
            self.sampler.observe(positions.detach(), times, density)
        rendering = composite(samples, output, quadrature=self.quadrature)
        background = self.behind(rays, rendering.opacity, generator)
        rendering = self._exposed(over(rendering, background), rays)
        if not samples.proposals:
            return rendering
        proposals = tuple(
            self._exposed(composite(placed, said, background, quadrature=self.quadrature), rays)
            for placed, said in samples.proposals
        )
        return replace(rendering, proposals=proposals)

    def _exposed(self, rendering: Rendering, rays: Rays) -> Rendering:
        if self.exposure is None or not self.training:
            return rendering
        return replace(rendering, rgb=self.exposure(rendering.rgb, rays.origins, rays.times))

    def behind(self, rays: Rays, opacity: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Colours (R, 3) behind rays of such opacity (R,); black where a costly background could not be seen."""
        with self.autocast(rays.origins.device):
            if not self.background.shows_beyond or opacity.is_cuda:  # counting rays would make the CPU wait for the GPU
                return self.background(rays, generator=generator)
            seen = (opacity.detach() < 1 - LEAST_LIGHT).nonzero()[:, 0]
            colors = self.background(rays[seen], generator=generator)
        return rays.origins.new_zeros(len(rays), 3).index_copy(0, seen, colors.to(rays.origins.dtype))

    def plain_background(self) -> Tensor:
        """The colour (3,) on which images with alpha are compared with this model's; black if it has several."""
        color = self.background.constant() if speaks_for(self.background, "constant", "forward") else None
        return torch.zeros(3, device=self.device) if color is None else color

    def update(self, step: int) -> None:
        """Let the sampler learn from the field, between training steps; `step` counts those done."""
        with self.autocast(self.device):
            self.sampler.update(self.field, step)

    def autocast(self, device: torch.device) -> torch.autocast:
        """A context in which networks run in the renderer's precision on a device, in float32 if it has no other."""
        dtype = PRECISIONS[self.precision]
        return torch.autocast(device.type, dtype=dtype, enabled=dtype is not None and has_bfloat16(device.type))

    def set_progress(self, progress: float) -> None:
        """Tell every part of which something follows training where it stands, in [0, 1], see `Scheduled`."""
        for module in self.modules():
            if isinstance(module, Scheduled):
                module.set_progress(progress)

    def invalidate(self) -> None:
        """Say that the model was changed from outside in mid-training: what was recorded of it does not hold."""
        self.generation += 1
        self._frames = None

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Evaluation mode while the block lasts; every part has its own mode after it."""
        modes = [(module, module.training) for module in self.modules()]
        self.eval()
        try:
            yield
        finally:
            for module, mode in modes:
                module.training = mode

    @torch.no_grad()
    def render_image(self, camera: Camera, time: float, *, chunk: int = 16384) -> Rendering:
        """Render a whole image in evaluation mode, without gradients.

        Args:
            camera: the view, on the model's device; its pose is taken in the precision of the model's parameters.
            time: in [0, 1].
            chunk: rays rendered at a time; bounds the memory.

        Returns:
            A `Rendering` with rgb (H, W, 3), opacity and depth (H, W), the distance along rays; no per-sample data.

        Raises:
            ValueError: for a time outside [0, 1] or a chunk that is not positive.
            MemoryError: if a GPU's memory does not suffice for one ray; until then the chunk is halved.
        """
        check_positive("chunk", chunk)
        check_within("time", time, "[0, 1]")
        dtype = next((p.dtype for p in self.parameters() if p.is_floating_point()), camera.pose.dtype)
        if camera.pose.dtype != dtype:
            camera = replace(camera, pose=camera.pose.to(dtype))
        with self.evaluating():
            columns = image_columns(self, camera, time, chunk, self._graph_frames())
        columns = columns.reshape(camera.intrinsics.height, camera.intrinsics.width, 5)
        return Rendering(rgb=columns[..., :3], opacity=columns[..., 3], depth=columns[..., 4])

    def _graph_frames(self) -> FrameGraphs | None:
        """What replays images as CUDA graphs; None where they are made op by op."""
        if not self.graphs or self.device.type != "cuda":
            return None
        if self._frames is None or self._frames.device != self.device:
            self._frames = FrameGraphs(self.device)
        return self._frames
