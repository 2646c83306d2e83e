"""A field without edges whose colours are known to rounding: what smooth density does to a quadrature rule."""

import math

import numpy as np
import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.core.geometry import clip_to_box
from dnerf.core.rays import Rays
from dnerf.fields.base import RadianceField

CLOUDS = (
    ((0.0, 0.0, 0.0), 0.34, 6.0), ((0.5, 0.3, 0.1), 0.22, 10.0), ((-0.4, 0.35, -0.2), 0.26, 4.0),
    ((0.1, -0.5, 0.25), 0.18, 14.0),
)  # fmt: skip
"""Centre, width (standard deviation) and peak density of each cloud."""


class SmoothClouds(RadianceField):
    """Gaussian clouds whose colour changes smoothly with place and time; they do not move."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("box", torch.tensor([[-1.6] * 3, [1.6] * 3]), persistent=False)
        self.box: Tensor

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Sum of the Gaussians."""
        density = torch.zeros_like(positions[..., 0])
        for center, width, peak in CLOUDS:
            offsets = (positions - positions.new_tensor(center)) / width
            density = density + peak * torch.exp(-0.5 * offsets.square().sum(-1))
        return density

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density, and a colour of sines."""
        waves = torch.sin(positions * positions.new_tensor((3.0, 4.0, 5.0)) + times[..., None])
        return FieldOutput(self.density(positions, times), 0.5 + 0.5 * waves)

    def optical_depth(self, rays: Rays, distances: Tensor) -> Tensor:
        """Optical depth (R, M) from far behind a ray's origin to distances (R, M): error functions.

        Directions need not be of unit length: those rounded to float32 are not, which would cost 3e-5 here.
        """
        total = torch.zeros_like(distances)
        speed = rays.directions.norm(dim=-1, keepdim=True)
        for center, width, peak in CLOUDS:
            offset = rays.origins - rays.origins.new_tensor(center)
            along = -(offset * rays.directions).sum(-1, keepdim=True) / speed.square()
            nearest = (offset + along * rays.directions).square().sum(-1, keepdim=True)
            amplitude = peak * width / speed * math.sqrt(math.pi / 2) * torch.exp(-0.5 * nearest / width**2)
            total = total + amplitude * (1 + torch.erf((distances - along) * speed / (width * math.sqrt(2))))
        return total


def exact_smooth(field: SmoothClouds, rays: Rays, panels: int = 48, nodes: int = 16) -> tuple[Tensor, float]:
    """Colours (R, 3) of rays on white, and a bound of their error.

    A composite Gauss-Legendre rule of colour times density times exp(-optical depth), the latter in closed form; the
    bound is ten times what four nodes fewer in every panel change.

    Args:
        field: which is rendered.
        rays: R rays in float64.
        panels: panels of the rule.
        nodes: Gauss nodes of each.
    """
    fine = _gauss(field, rays, panels, nodes)
    coarse = _gauss(field, rays, panels, nodes - 4)
    return fine, max(1e-15, 10 * float((fine - coarse).abs().max()))


def _gauss(field: SmoothClouds, rays: Rays, panels: int, nodes: int) -> Tensor:
    x, w = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(nodes))
    low, high = clip_to_box(rays.origins, rays.directions, rays.near, rays.far, field.box.double())
    edges = torch.linspace(0, 1, panels + 1, dtype=torch.float64)
    shares = (edges[:-1, None] + 0.5 * edges.diff()[:, None] * (1 + x)).flatten()
    masses = (0.5 * edges.diff()[:, None] * w).flatten()
    distances = low[:, None] + (high - low)[:, None] * shares
    positions = rays.origins[:, None] + distances[..., None] * rays.directions[:, None]
    output = field(positions, positions, rays.times[:, None].expand(distances.shape))
    start = field.optical_depth(rays, low[:, None])
    left = torch.exp(start - field.optical_depth(rays, distances))
    weights = masses * (high - low)[:, None] * output.density * left
    passed = torch.exp(start - field.optical_depth(rays, high[:, None]))
    return (weights[..., None] * output.rgb).sum(1) + passed
