"""Whole images: one fused kernel for models that can, one generic path for all others; CUDA graphs replay either."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dnerf.core.cameras import Camera
from dnerf.core.compositing import Rendering, safe_divide
from dnerf.core.rays import Rays, Samples
from dnerf.core.shortcuts import speaks_for
from dnerf.fields.base import PAD_TO, FrameTabled, RadianceField, evaluate_along_rays, field_at_time
from dnerf.kernels import MarchGrid, add_seen, trace_network
from dnerf.rendering.frame_graphs import FrameGraphs
from dnerf.samplers.base import Capacity, FixedCapacity, FrontToBack, OccupancyAware
from dnerf.samplers.visibility import PackedRounds, Source, walk_front_to_back

if TYPE_CHECKING:
    from dnerf.rendering.renderer import Renderer

logger = logging.getLogger(__name__)

FusedPath = Callable[[Rays], tuple[Tensor, Tensor]]
"""What rays of one time show without a background, (R, 5), and of which rays (R,) that is true."""


def image_columns(
    renderer: "Renderer", camera: Camera, time: float, chunk: int, graphs: FrameGraphs | None = None
) -> Tensor:
    """Colour, opacity and depth (P, 5) of all pixels of a view, on the model's device, in evaluation mode.

    The image is made so many rays at a time, or replayed by graphs, if there are some and memory for them.
    """
    if graphs is not None:
        columns = _replayed(renderer, camera, time, chunk, graphs)
        if columns is not None:
            return columns
    sampler = renderer.sampler
    numbers, rays, grid = None, None, None
    if _is_plain(renderer) and isinstance(sampler, OccupancyAware) and speaks_for(sampler, "march_grid", "forward"):
        grid = sampler.march_grid(time, camera.pose.dtype)
        # What lies beyond the box is behind all pixels.
        visible = None if renderer.background.shows_beyond else sampler.visible_rays(camera, time)
        if visible is not None:
            numbers, rays = visible
    rays = camera.rays(time) if rays is None else rays
    field = field_at_time(renderer.field, time, None if grid is None else grid.extent())
    with renderer.autocast(renderer.device):
        fused = None if grid is None else fused_path(renderer, field, grid, len(rays))
    parts = [_columns(part) for part in _in_chunks(renderer, rays, field, chunk, fused)]
    if numbers is None:
        return torch.cat(parts)
    image = _empty(renderer, camera, time)
    for pixels, part in zip(numbers.split([len(part) for part in parts]), parts, strict=True):
        image[pixels] = part
    return image


def fused_path(renderer: "Renderer", field: RadianceField, grid: MarchGrid, num_rays: int) -> FusedPath | None:
    """The kernel that renders rays of one time to their end, or None where there is none for this model.

    Its images differ from the generic path's by rounding, and by the light of intervals that only one of the two leaves
    out. The field and the grid of occupied cells are those of the time; so many rays will come.
    """
    if not (renderer.ends_early and isinstance(field, FrameTabled)):
        return None
    tables = field.frame_tables(grid, num_rays) if speaks_for(field, "frame_tables", "forward", "density") else None
    if tables is None:
        return None
    stop = renderer.stop_transmittance

    def path(rays: Rays) -> tuple[Tensor, Tensor]:
        states, is_done = trace_network(
            rays.origins, rays.directions, rays.near, rays.far, tables,
            step=grid.step, subdivision=grid.subdivision, subdivision_weight=grid.subdivision_weight,
            min_weight=stop, stop_transmittance=stop,
        )  # fmt: skip
        sums = torch.cat([states[:, 1:], 1 - states[:, :1]], dim=-1)
        return torch.where(is_done[:, None], sums, 0).to(rays.origins.dtype), is_done

    return path


def _is_plain(renderer: "Renderer") -> bool:
    """Whether rays show what the package's own renderer composites, rather than what a subclass makes of it."""
    return speaks_for(renderer, "render_image", "forward", "render_samples")


@torch.no_grad()
def _without_gradients(
    renderer: "Renderer", rays: Rays, field: RadianceField, fused: FusedPath | None = None
) -> Rendering:
    """What rays show of a field, without per-sample data: rays end where they are opaque."""
    if not _is_plain(renderer):
        return renderer(rays)
    numbers = torch.arange(len(rays), device=rays.near.device)
    sums = rays.origins.new_zeros(len(rays), 5)
    if fused is not None:
        with renderer.autocast(rays.origins.device):
            sums, is_done = fused(rays)
        numbers = (~is_done).nonzero()[:, 0]
        if not len(numbers):
            return _over_background(renderer, rays, sums)
    sampler = renderer.sampler
    marcher = sampler if isinstance(sampler, FrontToBack) and speaks_for(sampler, "first", "forward") else None
    if marcher is None or not renderer.ends_early:
        marcher = None
        with renderer.autocast(rays.origins.device):
            samples = sampler(rays, field)
        if not samples.is_packed:
            return renderer.render_samples(rays, samples, field)
        if not renderer.ends_early or samples.is_opaque:
            return renderer.render_samples(rays, samples.padded(PAD_TO), field)
        source: Source = (packed := PackedRounds(samples))
        numbers = packed.rays
    else:
        source = _marched(marcher, rays)

    def visit(ray_numbers: Tensor, part: Samples, transmittance: Tensor) -> Tensor:
        chosen = _of(rays, ray_numbers)
        with renderer.autocast(rays.origins.device):
            if marcher is not None:
                part, output = marcher.refined(part, chosen, field, transmittance, renderer.stop_transmittance)
            else:
                output = evaluate_along_rays(field, chosen, part)
        return add_seen(
            sums, ray_numbers, transmittance, part.starts, part.ends, part.offsets, output.density, output.rgb,
            part.points,
        )  # fmt: skip

    walk_front_to_back(source, numbers, renderer.stop_transmittance, visit)
    return _over_background(renderer, rays, sums)


def _marched(sampler: FrontToBack, rays: Rays) -> Source:
    """Samples that are looked for only when light still gets there."""
    begins = rays.near.clone()

    def source(numbers: Tensor, taken: int, size: int) -> tuple[Samples, Tensor]:
        part = sampler.first(replace(_of(rays, numbers), near=begins[numbers]), size)
        is_full = part.offsets.diff() == size
        begins[numbers[is_full]] = part.ends[part.offsets[1:][is_full] - 1]
        return part, is_full

    return source


def _over_background(renderer: "Renderer", rays: Rays, sums: Tensor) -> Rendering:
    """What rays show that meet rgb, depth times opacity, and opacity, (R, 5), before the background."""
    rgb, depth, opacity = sums[:, :3], sums[:, 3], sums[:, 4].clamp(max=1)
    rgb = rgb + (1 - opacity)[:, None] * renderer.behind(rays, opacity)
    return Rendering(rgb=rgb, opacity=opacity, depth=safe_divide(depth, opacity))


def _in_chunks(
    renderer: "Renderer", rays: Rays, field: RadianceField, chunk: int, fused: FusedPath | None
) -> Iterator[Rendering]:
    """Render so many rays at a time; half as many from where a GPU's memory does not suffice."""
    start = 0
    while start < len(rays):
        try:
            part = _without_gradients(renderer, rays[start : start + chunk], field, fused)
        except torch.OutOfMemoryError as error:
            if chunk == 1:
                raise MemoryError("the GPU's memory does not suffice for one ray") from error
            chunk //= 2
            logger.warning("the GPU's memory does not suffice: going on with chunk=%d", chunk)
            continue
        start += chunk
        yield part


def _empty(renderer: "Renderer", camera: Camera, time: float) -> Tensor:
    """An image (P, 5) of nothing: the background, no opacity, no depth."""
    size = camera.intrinsics.width * camera.intrinsics.height
    background = renderer.background
    color = background.constant() if speaks_for(background, "constant", "forward") else None
    if color is None:
        color = background(camera.rays(time))
    image = camera.pose.new_zeros(size, 5)
    image[:, :3] = color
    return image


def _replayed(renderer: "Renderer", camera: Camera, time: float, chunk: int, graphs: FrameGraphs) -> Tensor | None:
    """An image (P, 5) as one graph, which holds while tensors stay where they are; None for lack of memory."""
    assert isinstance(renderer.sampler, FixedCapacity)
    memory = tuple(tensor.data_ptr() for tensor in chain(renderer.parameters(), renderer.buffers()))
    way = (renderer.sampler.path_key(), renderer.precision, renderer.stop_transmittance, renderer.quadrature)

    def show(rays: Rays, marched: int, kept: int) -> tuple[Tensor, Tensor]:
        rendering = renderer(rays, capacity=Capacity(marched, kept, renderer.stop_transmittance))
        assert rendering.samples is not None
        assert rendering.samples.wanted is not None
        return _columns(rendering), rendering.samples.wanted

    try:
        return graphs.image(camera, time, chunk=chunk, way=way, memory=memory, show=show)
    except torch.OutOfMemoryError:
        graphs.forget()
        logger.warning("the GPU's memory does not suffice for a graph of %d rays: going on without", chunk)
        return None


def _columns(rendering: Rendering) -> Tensor:
    """Colour, opacity and depth (R, 5)."""
    return torch.cat([rendering.rgb, rendering.opacity[:, None], rendering.depth[:, None]], dim=-1)


def _of(rays: Rays, numbers: Tensor) -> Rays:
    """Those with such numbers, all different and in order: all of them as they are."""
    return rays if len(numbers) == len(rays) else rays[numbers]
