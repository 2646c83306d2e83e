"""The renderer: rays -> sampler -> field -> composite. It is the whole trainable model."""

import logging
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import torch
from torch import Tensor, nn

from dnerf.backgrounds import Background, ConstantBackground
from dnerf.cameras import Camera
from dnerf.checks import check_choice, check_positive
from dnerf.compositing import Rendering, composite, safe_divide
from dnerf.deformations.frame_lattice import FrozenDeformation
from dnerf.fields.base import PAD_TO, RadianceField, ask_along
from dnerf.frame_graphs import FrameGraphs
from dnerf.kernels import add_seen, few_nonzero
from dnerf.quadrature import check_rule
from dnerf.rays import Rays, Samples
from dnerf.samplers.base import Sampler
from dnerf.samplers.visibility import PackedRounds, Source, walk_front_to_back
from dnerf.tracing import FrameTracer, NetworkTracer, Tracer

logger = logging.getLogger(__name__)

FRAMES_THAT_SHARE = 16  # from so many on a sequence has gained what keeping things between its frames costs
MOST_TO_SHARE = 0.1  # of space, in which samples fall: haze is dearer to keep than to ask
PRECISIONS = {"float32": None, "bfloat16": torch.bfloat16}


class Renderer(nn.Module):
    """Renders rays of a radiance field; the one module that is trained, saved and shared between processes.

    Args:
        field: what is rendered.
        sampler: where along rays it is evaluated.
        background: what lies behind; white if None.
        quadrature: how density between samples is read, "constant", "linear" or "parabolic": see `dnerf.quadrature`.
        graphs: on a GPU, replay whole images as CUDA graphs, for samplers that can place samples in a fixed number of
            places. All of a picture's intervals are asked for densities then, at no lattice and in no bricks.
        precision: "float32", or "bfloat16" to run networks under autocast; positions, encodings and compositing stay
            float32 either way.
        stop_transmittance: whole images end a ray of packed samples once so little light is left, which changes
            colours by at most as much, and by as much again for each interval that a sampler which refines leaves out
            since it is seen as little; 0 to ask the field everywhere. Without effect on other quadratures than the
            constant one, whose intervals do not depend on their neighbours.

    Raises:
        ValueError: for another precision or quadrature, or a transmittance outside [0, 1).
    """

    def __init__(
        self,
        field: RadianceField,
        sampler: Sampler,
        background: Background | None = None,
        *,
        precision: str = "float32",
        stop_transmittance: float = 0.0,
        quadrature: str = "constant",
        graphs: bool = False,
    ) -> None:
        super().__init__()
        if not 0 <= stop_transmittance < 1:
            raise ValueError(f"stop_transmittance must be in [0, 1), got {stop_transmittance}")
        check_rule(quadrature)
        check_choice("precision", precision, tuple(PRECISIONS))
        self.field = field
        self.sampler = sampler
        self.background = ConstantBackground("white") if background is None else background
        self.precision = precision
        self.stop_transmittance = stop_transmittance
        self.quadrature = quadrature
        self.graphs = graphs
        self._frames: FrameGraphs | None = None

    @property
    def device(self) -> torch.device:
        """Where the model lives."""
        return next(chain(self.parameters(), self.buffers())).device

    def forward(self, rays: Rays, *, generator: torch.Generator | None = None) -> Rendering:
        """Render R rays; in training mode the sampler also learns from what the field says.

        Args:
            rays: R rays.
            generator: randomness of samplers and backgrounds in training mode.
        """
        with self.autocast(rays.origins.device):
            samples = self.sampler(rays, self.field, generator=generator)
        return self._render(rays, samples, self.field, generator)

    def _render(
        self, rays: Rays, samples: Samples, field: RadianceField, generator: torch.Generator | None = None
    ) -> Rendering:
        with self.autocast(rays.origins.device):
            positions, directions, times = samples.locate(rays)
            output = field(positions, directions, times)
        if self.training:
            density = torch.where(samples.lengths > 0, output.density.detach(), 0)  # of padding: nothing
            self.sampler.observe(positions.detach(), times, density)
        background = self.background(rays.directions, generator=generator)
        rendering = composite(samples, output, background, quadrature=self.quadrature)
        if not samples.proposals:
            return rendering
        proposals = tuple(
            composite(placed, said, background, quadrature=self.quadrature) for placed, said in samples.proposals
        )
        return Rendering(**{**vars(rendering), "proposals": proposals})

    def _without_gradients(self, rays: Rays, field: RadianceField, tracer: Tracer | None = None) -> Rendering:
        """What `forward` shows of a field, without per-sample data: rays end where they are opaque.

        Args:
            rays: R rays.
            field: what is rendered.
            tracer: shows what it can of them.
        """
        numbers = torch.arange(len(rays), device=rays.near.device)
        sums = rays.origins.new_zeros(len(rays), 5)
        if tracer is not None:
            with self.autocast(rays.origins.device):
                sums, is_done = tracer(rays)
            numbers = few_nonzero(~is_done)
            if not len(numbers):
                return self._shown(rays, sums)
        source = self._marched(rays) if self._ends_early else None
        refines = source is not None
        if source is None:
            with self.autocast(rays.origins.device):
                samples = self.sampler(rays, field)
            if not samples.is_packed:
                return self._render(rays, samples, field)
            if not self._ends_early:
                return self._render(rays, samples.padded(PAD_TO), field)
            source = packed = PackedRounds(samples)
            numbers = packed.rays

        def visit(ray_numbers: Tensor, part: Samples, transmittance: Tensor) -> Tensor:
            chosen = _of(rays, ray_numbers)
            with self.autocast(rays.origins.device):
                if refines:
                    part, output = self.sampler.refined(part, chosen, field, transmittance, self.stop_transmittance)
                else:
                    assert part.ray_indices is not None
                    output = ask_along(field, chosen, part.ray_indices, part.distances)
            return add_seen(
                sums, ray_numbers, transmittance, part.starts, part.ends, part.offsets, output.density, output.rgb,
                part.points,
            )  # fmt: skip

        walk_front_to_back(source, numbers, self.stop_transmittance, visit)
        return self._shown(rays, sums)

    def _shown(self, rays: Rays, sums: Tensor) -> Rendering:
        """What rays show that meet rgb, depth times opacity, and opacity, (R, 5), before the background."""
        rgb, depth, opacity = sums[:, :3], sums[:, 3], sums[:, 4].clamp(max=1)
        rgb = rgb + (1 - opacity)[:, None] * self.background(rays.directions)
        return Rendering(rgb=rgb, opacity=opacity, depth=safe_divide(depth, opacity))

    @property
    def _ends_early(self) -> bool:
        return self.stop_transmittance > 0 and self.quadrature == "constant"

    def _marched(self, rays: Rays) -> Source | None:
        """Samples that are looked for only when light still gets there; None if the sampler places all at once."""
        begins = rays.near.clone()

        def source(numbers: Tensor, taken: int, size: int) -> tuple[Samples, Tensor]:
            part = self.sampler.first(replace(_of(rays, numbers), near=begins[numbers]), size)
            assert part is not None
            is_full = part.offsets.diff() == size
            begins[numbers[is_full]] = part.ends[part.offsets[1:][is_full] - 1]
            return part, is_full

        return None if self.sampler.first(rays[:0], 1) is None else source

    def update(self, step: int) -> None:
        """Let the sampler learn from the field, between training steps; `step` counts those done."""
        with self.autocast(self.device):
            self.sampler.update(self.field, step)

    def learn(self, probes: Tensor) -> None:
        """Let the sampler learn from the field at random places, see `Sampler.learn`."""
        with self.autocast(self.device):
            self.sampler.learn(self.field, probes)

    def autocast(self, device: torch.device) -> torch.autocast:
        """A context in which networks run in the renderer's precision on a device."""
        dtype = PRECISIONS[self.precision]
        return torch.autocast(device.type, dtype=dtype, enabled=dtype is not None)

    def set_progress(self, progress: float) -> None:
        """Tell every module that changes while training goes on (encoding windows) where it stands, in [0, 1]."""
        for module in self.modules():
            listener = getattr(module, "set_progress", None)
            if module is not self and callable(listener):
                listener(progress)

    def for_sequence(self, num_frames: int) -> "Renderer":
        """A renderer of the same finished model for so many frames; this one, unless sharing work between them pays.

        It does for long sequences of scenes that are mostly empty, where no kernel asks the field itself as quickly
        (`NetworkTracer`). What the frames share is computed as they come and
        kept (`RadianceField.finished`), so it knows nothing of later changes of the field. Sampler and background are
        this renderer's own.
        """
        pays = num_frames >= FRAMES_THAT_SHARE and self.sampler.share <= MOST_TO_SHARE and not self._replays
        with self.autocast(self.device):
            pays = pays and not (self._ends_early and NetworkTracer.serves(self.field))
        field = self.field.finished() if pays else self.field
        if field is self.field:
            return self
        model = Renderer(
            field,
            self.sampler,
            self.background,
            precision=self.precision,
            stop_transmittance=self.stop_transmittance,
            quadrature=self.quadrature,
            graphs=self.graphs,
        )
        model.training = self.training
        return model

    @torch.no_grad()
    def render_image(self, camera: Camera, time: float, *, chunk: int = 16384) -> Rendering:
        """Render a whole image in evaluation mode, without gradients.

        Args:
            camera: the view, on the model's device.
            time: in [0, 1].
            chunk: rays rendered at a time; bounds the memory.

        Returns:
            A `Rendering` with rgb (H, W, 3), opacity and depth (H, W); no per-sample data.

        Raises:
            ValueError: for a time outside [0, 1] or a chunk that is not positive.
            MemoryError: if a GPU's memory does not suffice for one ray; until then the chunk is halved.
        """
        check_positive("chunk", chunk)
        if not 0 <= time <= 1:
            raise ValueError(f"time must be in [0, 1], got {time}")
        modes = [(module, module.training) for module in self.modules()]
        self.eval()
        try:
            picture = self._replayed(camera, time, chunk) if self._replays else None
            if picture is None:
                picture = self._walked(camera, time, chunk)
        finally:
            for module, mode in modes:
                module.training = mode
        picture = picture.reshape(camera.intrinsics.height, camera.intrinsics.width, 5)
        return Rendering(rgb=picture[..., :3], opacity=picture[..., 3], depth=picture[..., 4])

    def _walked(self, camera: Camera, time: float, chunk: int) -> Tensor:
        """A picture (P, 5) whose rays end where they are opaque."""
        seen = self.sampler.seen_rays(camera, time)
        numbers, rays = (None, camera.rays(time)) if seen is None else seen
        grid = self.sampler.grid_at(time, camera.pose.dtype)
        field = self.field.at_time(time, None if grid is None else grid.extent())
        tracer: Tracer | None = None
        if self._ends_early:
            tracer = FrameTracer.of(field, grid, time, self.stop_transmittance)
        lattice = getattr(field, "deformation", None)
        if tracer is None and grid is not None and isinstance(lattice, FrozenDeformation):
            with self.autocast(self.device):
                if lattice.fill_around(grid, len(rays)) and self._ends_early:
                    tracer = NetworkTracer.of(field, grid, self.stop_transmittance)
        parts = list(self._in_chunks(rays, field, chunk, tracer))
        columns = [_columns(part) for part in parts]
        if numbers is None:
            return torch.cat(columns)
        picture = self._empty(camera, time)
        for pixels, column in zip(numbers.split([len(c) for c in columns]), columns, strict=True):
            picture[pixels] = column
        return picture

    @property
    def _replays(self) -> bool:
        return self.graphs and self.device.type == "cuda"

    def _replayed(self, camera: Camera, time: float, chunk: int) -> Tensor | None:
        """A picture (P, 5) as one graph, which holds while tensors stay where they are; None for lack of memory."""
        if self._frames is None or self._frames.device != self.device:
            self._frames = FrameGraphs(self.device)
        memory = tuple(tensor.data_ptr() for tensor in chain(self.parameters(), self.buffers()))
        way = (self.sampler.settings, self.precision, self.stop_transmittance, self.quadrature)
        try:
            return self._frames.picture(camera, time, chunk=chunk, way=way, memory=memory, show=self._fixed)
        except torch.OutOfMemoryError:
            self._frames = None
            logger.warning("the GPU's memory does not suffice for a graph of %d rays: going on without", chunk)
            return None

    def _fixed(self, rays: Rays, marched: int, kept: int) -> tuple[Tensor, Tensor]:
        with self.autocast(rays.origins.device):
            samples, wanted = self.sampler.to_size(rays, self.field, marched, kept, min_weight=self.stop_transmittance)
        return _columns(self._render(rays, samples, self.field)), wanted

    def _empty(self, camera: Camera, time: float) -> Tensor:
        """A picture (P, 5) of nothing: the background, no opacity, no depth."""
        size = camera.intrinsics.width * camera.intrinsics.height
        if isinstance(self.background, ConstantBackground):
            color = self.background(camera.pose.new_zeros(1, 3))
        else:
            color = self.background(camera.rays(time).directions)
        picture = color.new_zeros(size, 5)
        picture[:, :3] = color
        return picture

    def _in_chunks(self, rays: Rays, field: RadianceField, chunk: int, tracer: Tracer | None) -> Iterator[Rendering]:
        """Render so many rays at a time; half as many from where a GPU's memory does not suffice."""
        start = 0
        while start < len(rays):
            try:
                part = self._without_gradients(rays[start : start + chunk], field, tracer)
            except torch.OutOfMemoryError as error:
                if chunk == 1:
                    raise MemoryError("the GPU's memory does not suffice for one ray") from error
                chunk //= 2
                logger.warning("the GPU's memory does not suffice: going on with chunk=%d", chunk)
                continue
            start += chunk
            yield part


def _columns(shown: Rendering) -> Tensor:
    """Colour, opacity and depth (R, 5)."""
    return torch.cat([shown.rgb, shown.opacity[:, None], shown.depth[:, None]], dim=-1)


def _of(rays: Rays, numbers: Tensor) -> Rays:
    """Those with such numbers, all different and in order: all of them as they are."""
    return rays if len(numbers) == len(rays) else rays[numbers]
