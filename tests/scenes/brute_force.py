"""Rays, and images by a slow and independent way: edges by bisection of the field's values, then fine quadrature."""

import math

import numpy as np
import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.core.rays import Rays
from dnerf.scenes import AnalyticScene

START = [-2.0, 0.0, 0.0]
COLOR_JUMP = 0.02
"""Smooth textures change less than this over the steps of the first scan (1e-3): slopes stay below 20."""


def make_rays(origins=(START,), directions=((1.0, 0.0, 0.0),), *, near=0.0, far=6.0, times=0.0) -> Rays:
    """Rays along the x axis unless stated otherwise."""
    origin, direction = (torch.tensor(x, dtype=torch.float64) for x in (origins, directions))
    direction = torch.nn.functional.normalize(direction, dim=-1).expand_as(origin)
    one = torch.ones_like(origin[:, 0])
    return Rays(origin, direction, torch.tensor(times, dtype=torch.float64) * one, near * one, far * one)


def field_on_ray(scene: AnalyticScene, ray: Rays, distances: Tensor) -> FieldOutput:
    """The field along one ray, at (M,) distances."""
    directions = ray.directions.expand(len(distances), 3)
    positions = ray.origins + distances[:, None] * directions
    return scene(positions, directions, ray.times.expand(len(distances)))


def differs(a: FieldOutput, b: FieldOutput) -> Tensor:
    """Whether something jumps between pairs of points."""
    return ((a.density - b.density).abs() > 1e-9) | ((a.rgb - b.rgb).abs() > COLOR_JUMP).any(-1)


def find_edges(scene: AnalyticScene, ray: Rays) -> Tensor:
    """Distances along one ray where density or colour jumps, near and far included: two scans and a bisection."""
    low, high, width = ray.near, ray.far, (ray.far - ray.near).item()
    for steps in (6000, 300):
        grid = (low[:, None] + (high - low)[:, None] * torch.linspace(0, 1, steps + 1, dtype=low.dtype)).flatten()
        values = field_on_ray(scene, ray, grid)
        left, right = (FieldOutput(values.density[s], values.rgb[s]) for s in (slice(0, -1), slice(1, None)))
        jumps = differs(left, right).nonzero()[:, 0]
        width /= steps
        within = grid[jumps + 1] - grid[jumps] < 2 * width  # not from one bracket of the first scan to the next
        low, high = grid[jumps[within]], grid[jumps[within] + 1]
    left = field_on_ray(scene, ray, low)
    for _ in range(40):
        middle = 0.5 * (low + high)
        beyond = differs(left, field_on_ray(scene, ray, middle))
        low, high = torch.where(beyond, low, middle), torch.where(beyond, middle, high)
    return torch.cat([ray.near, 0.5 * (low + high), ray.far])


def render_ray(scene: AnalyticScene, ray: Rays, background: float) -> tuple[Tensor, float, float]:
    """Colour, opacity and expected depth of one ray, Gauss-Legendre on panels of optical depth at most 1 / 4."""
    x, w = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(12))
    edges = find_edges(scene, ray)
    densities = field_on_ray(scene, ray, 0.5 * (edges[:-1] + edges[1:])).density.tolist()
    points, weights, transmittance = [x[:0]], [w[:0]], 1.0
    for start, end, sigma in zip(edges.tolist(), edges[1:].tolist(), densities):
        depth = min(sigma * (end - start), 40.0)
        if depth == 0 or transmittance < 1e-15:
            continue
        cuts = torch.linspace(0, depth / sigma, math.ceil(4 * depth) + 1, dtype=torch.float64)
        half = 0.5 * cuts.diff()[:, None]
        t = (cuts[:-1, None] + half * (1 + x)).flatten()
        points.append(start + t)
        weights.append((half * w).flatten() * sigma * torch.exp(-sigma * t) * transmittance)
        transmittance *= math.exp(-depth)
    t, weight = torch.cat(points), torch.cat(weights)
    color = (weight[:, None] * field_on_ray(scene, ray, t).rgb).sum(0)
    opacity = 1 - transmittance
    return color + background * transmittance, opacity, (weight * t).sum().item() / max(opacity, 1e-300)
