"""The surface of a field at one time: marching cubes on a lattice over a box."""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive, check_whole
from dnerf.core.geometry import safe_normalize
from dnerf.fields.base import RadianceField, field_at_time, surface_of
from dnerf.fields.normals import normals

MOST_AT_ONCE = 1 << 18  # positions evaluated in one go: bounds the memory of networks
BYTES_PER_POINT = 16  # of the lattice: values, and what marching cubes makes of them
OPAQUE_LENGTH = 0.01  # share of the box's longest side in which the surface of a density absorbs half the light
EPSILON = 1e-7  # for values of zero, which have no side
ROUNDS = 6  # of the search along a lattice edge

Values = Callable[[Tensor, Tensor], Tensor]
"""Positions (N, n) and times (N,) to numbers (N, ...)."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with a normal and a colour at each vertex, on the CPU."""

    vertices: Tensor  # (V, 3) in world units
    faces: Tensor  # (F, 3) int64, counter-clockwise seen from outside
    normals: Tensor  # (V, 3) unit, outwards
    rgb: Tensor  # (V, 3) in [0, 1], as stored in images


@torch.no_grad()
def extract_surface(
    field: RadianceField, time: float, *, box: Sequence[Sequence[float]] | Tensor, resolution: int = 128,
    level: float | None = None, min_share: float = 0.02, close_gaps: float = 0.0,
) -> Mesh:  # fmt: skip
    """The surface of a field at a time, closed where the box cuts it.

    Of a `SignedDistance` it is where the distance is `level`, of other fields where the density is. A density has no
    surface of its own; by default it is taken where half the light is absorbed within `OPAQUE_LENGTH` of the box,
    whatever the lattice. Vertices lie on lattice edges and are searched for there, since densities are far from linear.
    Colours are those seen from outside, along minus the normal. Cavities, whose insides no image shows, are filled.

    Args:
        field: in world or canonical space, in evaluation mode.
        time: in [0, 1].
        box: (2, 3) corners of the lattice.
        resolution: cells, which are cubes, along the box's longest side.
        level: distance, in world units, or density, in 1 / world unit; None for 0 or the default above.
        min_share: connected parts with less than this share of the largest part's triangles are left out.
        close_gaps: width, as a share of the box's longest side, of gaps into cavities that are closed. Density fields
            are often hollow, with a skin that has pinholes.

    Raises:
        ValueError: if nothing crosses the level, the lattice is too large for the memory, a setting is out of range or
            the extra is missing.
    """
    check_whole("resolution", resolution)
    for name, share in (("min_share", min_share), ("close_gaps", close_gaps)):
        if not 0 <= share <= 1:
            raise ValueError(f"{name} must be in [0, 1], got {share}")
    corners = as_box(box).cpu()
    size, center = float((corners[1] - corners[0]).max()), corners.mean(0)
    surface, now = surface_of(field), field_at_time(field, time)
    if level is None:
        level = math.log(2) / (OPAQUE_LENGTH * size) if surface is None else 0.0
    if surface is None:
        check_positive("level", level)

    def values(x: Tensor) -> Tensor:
        """Negative inside the field's shape and the box."""
        if surface is None:  # the logarithm is linear where density falls exponentially
            inside = math.log(level) - _evaluated(field, now.density, x, time).clamp(min=1e-6 * level).log()
        else:
            inside = _evaluated(field, surface.distance, x, time) - level
        return torch.maximum(inside, ((x - center).abs() - (corners[1] - center)).amax(-1))

    low, spacing = corners[0] - size / resolution, size / resolution
    lattice = _lattice(values, corners, spacing)
    if not bool((lattice < 0).any()):
        what, least = ("density", level * (-lattice.min()).exp()) if surface is None else ("distance", lattice.min())
        raise ValueError(
            f"the mesh is empty: no {what} of {level:.4g} at time {time:g} in the box; the nearest is {least:.4g} "
            f"(level chooses another, resolution={resolution} a finer lattice)"
        )
    vertices, faces = _marching_cubes(_filled(lattice, math.ceil(0.5 * close_gaps * resolution)))
    vertices, faces = _large_parts(_refined(vertices, lattice, values, low, spacing), faces, min_share)
    outwards = vertex_normals(vertices, faces)
    if surface is not None:  # densities' own gradients are too noisy
        outwards = _evaluated(field, lambda x, times: normals(field, x, times), vertices, time)
    seen = torch.cat([vertices, -outwards], dim=-1)
    rgb = _evaluated(field, lambda x, times: now(x[:, :3], x[:, 3:], times).rgb, seen, time)
    return Mesh(vertices, faces, outwards, rgb.clamp(0, 1))


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals (V, 3) of vertices (V, 3): a mean over the triangles (F, 3) around each, exact on balls.

    The cross products of a corner's edges, over the squares of both lengths (Max 1999, "Weights for computing vertex
    normals from facet normals"): marching cubes makes slivers, which other weights are sensitive to.
    """
    corners, result = vertices[faces], torch.zeros_like(vertices)
    for i in range(3):
        first, second = corners[:, i - 2] - corners[:, i], corners[:, i - 1] - corners[:, i]
        lengths = first.square().sum(-1) * second.square().sum(-1)
        weights = torch.where(lengths > 0, 1 / lengths, 0)[:, None]
        result.index_add_(0, faces[:, i], weights * torch.linalg.cross(first, second))
    return safe_normalize(result)


def share_on_box(mesh: Mesh, box: Sequence[Sequence[float]] | Tensor) -> float:
    """Share of a mesh's area that lies in the sides of a box: where `extract_surface` closes what its box cuts."""
    corners, places = as_box(box).cpu(), mesh.vertices[mesh.faces]
    is_near = (places[:, :, None] - corners).abs() <= 1e-4 * (corners[1] - corners[0]).max()  # (F, 3, 2, 3)
    areas = torch.linalg.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]).norm(dim=-1)
    return float((areas * is_near.all(1).flatten(1).any(1)).sum() / areas.sum())


def imported(module: str) -> Any:
    """A module of the extra; ValueError if it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ValueError("meshes need the extra: pip install 'dnerf[mesh]'") from error


def device_of(module: nn.Module) -> torch.device:
    """Where a module's first tensor is; the CPU if it has none."""
    return next((x.device for x in (*module.parameters(), *module.buffers())), torch.device("cpu"))


def _evaluated(field: RadianceField, function: Values, positions: Tensor, time: float) -> Tensor:
    """A function of positions, part by part where the field is, in float32, on the CPU."""
    device = device_of(field)
    with torch.autocast(device.type, enabled=False):  # bfloat16 would make terraces
        parts = (part.to(device) for part in positions.split(MOST_AT_ONCE))
        return torch.cat([function(part, part.new_full(part.shape[:1], time)).float().cpu() for part in parts])


def _lattice(values: Callable[[Tensor], Tensor], box: Tensor, spacing: float) -> Tensor:
    """Values (X, Y, Z) at lattice points from one cell before the box to one cell or more behind it."""
    counts = [math.ceil(side / spacing - 1e-4) + 3 for side in (box[1] - box[0]).tolist()]
    needed = BYTES_PER_POINT * math.prod(counts) / 2**30
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30 if hasattr(os, "sysconf") else math.inf
    if needed > there:
        raise ValueError(
            f"resolution must leave a lattice that fits into memory: one of {' x '.join(map(str, counts))} points "
            f"needs {needed:.3g} GiB of {there:.3g}; choose a smaller one"
        )
    x, y, z = (start - spacing + spacing * torch.arange(count) for start, count in zip(box[0], counts))
    return torch.stack([values(torch.cartesian_prod(plane[None], y, z)).reshape(len(y), len(z)) for plane in x])


def _filled(lattice: Tensor, reach: int) -> Tensor:
    """A lattice that is inside, too, where one cannot get from outside through gaps of more than 2 reach cells."""
    ndimage = imported("scipy.ndimage")
    empty = nn.functional.pad(lattice >= 0, (reach,) * 6, value=True).numpy()
    wide = ndimage.binary_erosion(empty, iterations=reach, border_value=True) if reach else empty
    parts = ndimage.label(wide)[0]
    reached = parts == parts[0, 0, 0]
    if reach:  # one more than before, for shallow hollows to stay
        reached = ndimage.binary_dilation(reached, iterations=reach + 1, mask=empty)
    inner = slice(reach, -reach or None)
    return torch.where((lattice >= 0) & ~torch.from_numpy(reached[inner, inner, inner]), -lattice - EPSILON, lattice)


def _marching_cubes(lattice: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices (V, 3), in cells, and faces (F, 3) where the lattice changes its sign (Lewiner et al. 2003)."""
    # A value of zero would put several vertices into one place.
    volume = torch.where(lattice == 0, EPSILON, lattice).numpy()
    vertices, faces, _, _ = imported("skimage.measure").marching_cubes(volume, 0.0, gradient_direction="descent")
    return torch.from_numpy(vertices.copy()), torch.from_numpy(faces.astype("int64"))


def _refined(
    vertices: Tensor, lattice: Tensor, values: Callable[[Tensor], Tensor], low: Tensor, spacing: float
) -> Tensor:
    """World positions of vertices, in cells, each moved along its lattice edge to where the value is zero.

    By the Illinois variant of the false position (Dowell and Jarratt 1971). Vertices on no single edge (Lewiner's
    ambiguous cells have some) stay, and so do those of gaps that were closed.
    """
    first = vertices.floor()
    along = vertices != first
    ends = [lattice[tuple(x.long().unbind(-1))] for x in (first, first + along)]
    chosen = (along.sum(-1) == 1) & ((ends[0] < 0) != (ends[1] < 0))
    first, step = first[chosen], along[chosen].to(first.dtype)
    value_a, value_b = ends[0][chosen], ends[1][chosen]
    a, b = torch.zeros_like(value_a), torch.ones_like(value_a)
    at, before = a, torch.zeros_like(value_a)
    for _ in range(ROUNDS):
        at = (a - value_a * (b - a) / (value_b - value_a)).clamp(1e-4, 1 - 1e-4)  # apart from others at this point
        value = values(low + spacing * (first + at[:, None] * step))
        is_a = (value < 0) == (value_a < 0)
        # An end that stays twice counts half: otherwise it would stay for ever.
        share = torch.where((value < 0) == (before < 0), 0.5, 1.0)
        value_a, value_b = torch.where(is_a, value, share * value_a), torch.where(is_a, share * value_b, value)
        before = value
        a, b = torch.where(is_a, at, a), torch.where(is_a, b, at)
    vertices[chosen] = first + at[:, None] * step
    return low + spacing * vertices


def _large_parts(vertices: Tensor, faces: Tensor, min_share: float) -> tuple[Tensor, Tensor]:
    """Without the connected parts that have few triangles."""
    rows, columns = torch.cat([faces[:, :2], faces[:, 1:]]).T.numpy()
    graph = imported("scipy.sparse").coo_array((rows >= 0, (rows, columns)), shape=(len(vertices),) * 2)
    label = imported("scipy.sparse.csgraph").connected_components
    part = torch.from_numpy(label(graph, directed=False)[1])[faces[:, 0]]
    counts = part.bincount()
    used, faces = faces[(counts >= min_share * counts.max())[part]].unique(return_inverse=True)
    return vertices[used], faces
