"""Slow, obvious versions of what the package computes fast: plain Python loops that share no code with it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.core.rays import Rays, Samples
from dnerf.core.schedules import Ramp
from dnerf.fields.base import RadianceField
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import OccupancyGrid, OccupancySampler, Sampler
from dnerf.scenes import AnalyticScene

OF_THE_GRID = {"num_slabs", "threshold", "decay", "update_every", "num_probes", "dilation", "render_dilation"}


def transmittance(optical_depths: Sequence[float]) -> float:
    """Light left after intervals of the given optical depths."""
    return math.exp(-math.fsum(optical_depths))


def ray_weights(optical_depths: Sequence[float]) -> list[float]:
    """Weight of each interval of one ray: what enters it times the share it absorbs."""
    return [
        transmittance(optical_depths[:i]) * -math.expm1(-optical_depth)
        for i, optical_depth in enumerate(optical_depths)
    ]


@dataclass(frozen=True)
class Pixel:
    """What one ray shows."""

    rgb: list[float]
    opacity: float
    depth: float


def composite_ray(
    starts: Sequence[float], ends: Sequence[float], densities: Sequence[float], colors: Sequence[Sequence[float]],
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> Pixel:  # fmt: skip
    """Composite the intervals of one ray, sampled at their middles, front to back."""
    weights = ray_weights([s * (b - a) for a, b, s in zip(starts, ends, densities, strict=True)])
    opacity = math.fsum(weights)
    depth = math.fsum(w * 0.5 * (a + b) for w, a, b in zip(weights, starts, ends, strict=True))
    rgb = [
        math.fsum(w * color[c] for w, color in zip(weights, colors, strict=True)) + (1 - opacity) * background[c]
        for c in range(3)
    ]
    return Pixel(rgb, opacity, depth / opacity if opacity > 0 else 0.0)


def invert_histogram(edges: Sequence[float], weights: Sequence[float], u: float) -> float:
    """Position below which the share `u` of a histogram's weight lies, uniform within bins."""
    target = u * math.fsum(weights)
    passed = 0.0
    for low, high, weight in zip(edges[:-1], edges[1:], weights, strict=True):
        if weight > 0 and passed + weight >= target:
            return low + (high - low) * (target - passed) / weight
        passed += weight
    return edges[-1]


def sinusoidal(values: Sequence[float], num_frequencies: int, window: Sequence[float]) -> list[float]:
    """The sinusoidal encoding of one vector: itself, then every octave's sines, then every octave's cosines."""
    encoded = list(values)
    for wave in (math.sin, math.cos):
        for k in range(num_frequencies):
            encoded += [window[k] * wave(2**k * value) for value in values]
    return encoded


def line_in_box(
    origin: Sequence[float], direction: Sequence[float], low: Sequence[float], high: Sequence[float]
) -> tuple[float, float] | None:
    """Parameters at which a line enters and leaves a closed box, in exact arithmetic; None if it misses."""
    enter: Fraction | float = -math.inf
    leave: Fraction | float = math.inf
    for o, d, a, b in zip(*([Fraction(x) for x in row] for row in (origin, direction, low, high)), strict=True):
        if d == 0:
            if not a <= o <= b:
                return None
            continue
        first, second = sorted(((a - o) / d, (b - o) / d))
        enter, leave = max(enter, first), min(leave, second)
    return None if enter > leave else (float(enter), float(leave))


def rotation_coefficients(angle: float, num_terms: int = 60) -> tuple[float, float, float]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 from their power series in exact arithmetic."""
    squared = Fraction(angle) ** 2
    sums = []
    for first in (1, 2, 3):
        total = Fraction(0)
        for k in range(num_terms):
            total += (-squared) ** k / math.factorial(2 * k + first)
        sums.append(float(total))
    return sums[0], sums[1], sums[2]


def sphere_quadrature(num_polar: int, num_around: int) -> tuple[Tensor, Tensor]:
    """Unit vectors (Q, 3) and weights (Q,) that integrate polynomials on the sphere exactly, in float64.

    Gauss-Legendre in z for degrees below `2 * num_polar`, equal angles around for orders below `num_around`.
    """
    matrix = torch.zeros(num_polar, num_polar, dtype=torch.float64)
    for k in range(1, num_polar):
        matrix[k, k - 1] = matrix[k - 1, k] = k / math.sqrt(4 * k * k - 1)
    heights, vectors = torch.linalg.eigh(matrix)
    weights = 2 * vectors[0] ** 2
    angles = 2 * math.pi * torch.arange(num_around, dtype=torch.float64) / num_around
    radii = (1 - heights**2).sqrt()
    around = torch.stack([angles.cos(), angles.sin()], -1)
    points = torch.cat([radii[:, None, None] * around, heights[:, None, None].expand(num_polar, num_around, 1)], dim=-1)
    return points.reshape(-1, 3), (weights[:, None] * (2 * math.pi / num_around)).expand(-1, num_around).flatten()


class FormulaField(RadianceField):
    """A field without parameters: density of a position, colour of position, direction and time."""

    def __init__(self, density: Callable[[Tensor], Tensor], color: Callable[[Tensor, Tensor, Tensor], Tensor]) -> None:
        super().__init__()
        self.density_of = density
        self.color_of = color

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.density_of(positions)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), self.color_of(positions, directions, times))


def fog(density: float = 0.7) -> FormulaField:
    """Fog of constant density whose colour is (time, 0.5, 1)."""
    return FormulaField(
        lambda x: torch.full_like(x[..., 0], density),
        lambda x, d, t: torch.stack([t, torch.full_like(t, 0.5), torch.ones_like(t)], dim=-1),
    )


def soft_ball(center: Sequence[float] = (0.0, 0.0, 0.0), width: float = 0.4, peak: float = 8.0) -> FormulaField:
    """A Gaussian ball whose colour varies smoothly with position."""

    def density(positions: Tensor) -> Tensor:
        offsets = positions - positions.new_tensor(center)
        return peak * torch.exp(-0.5 * (offsets / width).square().sum(-1))

    return FormulaField(density, lambda x, d, t: torch.sigmoid(x))


def rays_towards_origin(num_rays: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> Rays:
    """Rays from a sphere of radius 3 to points near the origin, each with its own time, near 1 and far 5."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(num_rays, 3, generator=generator, dtype=torch.float64), dim=-1)
    targets = 0.5 * torch.randn(num_rays, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(targets - 3 * origins, dim=-1)
    times = torch.rand(num_rays, generator=generator, dtype=torch.float64)
    ones = torch.ones_like(times)
    return Rays(3 * origins, directions, times, ones, 5 * ones).to(dtype)


def occupancy_sampler(
    box: Sequence[Sequence[float]], step_size: float = 0.02, resolution: int = 64, *,
    kind: type[OccupancySampler] = OccupancySampler, coarse_step: float | None = None, coarse_until: float = 0.5,
    **others: Any,
) -> OccupancySampler:  # fmt: skip
    """An occupancy sampler of some kind and its grid, from the settings of both.

    Training begins with `coarse_step`, if given, and reaches `step_size`, that of images, by equal factors at progress
    `coarse_until`, from which on intervals are cut.
    """
    grid = OccupancyGrid(box, resolution, **{name: others.pop(name) for name in OF_THE_GRID & others.keys()})
    step = step_size if coarse_step is None else Ramp(coarse_step, step_size, end=coarse_until, kind="exponential")
    return kind(grid, step, **{"subdivide_from": coarse_until, **others})


class ExactSampler(Sampler):
    """Samples of an exact scene: its bodies' own intervals along rays."""

    def __init__(self, scene: AnalyticScene) -> None:
        super().__init__()
        self.scene = scene

    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        return self.scene.exact_samples(rays)


def exact(scene: AnalyticScene) -> Renderer:
    """An exact scene as a model."""
    return Renderer(scene, ExactSampler(scene)).eval()
