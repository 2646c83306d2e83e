"""Measures of surfaces are those of a ball whose surface is known."""

import math

import pytest
import torch
from torch import Tensor

from benchmarks.surfaces import _angle, _nearest, _seen, _volume
from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.compositing import FieldOutput
from dnerf.fields import RadianceField, SignedDistance
from dnerf.meshing import extract_surface
from dnerf.rendering import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import AnalyticScene
from dnerf.scenes.base import Body
from dnerf.scenes.motions import Fixed
from dnerf.scenes.shapes import Ball
from dnerf.scenes.textures import Plain

BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
SCENE = AnalyticScene([Body(Ball(0.5), Plain((1.0, 0.0, 0.0)), Fixed((0.0, 0.0, 0.0)), 80.0)], box=BOX)


class Leaning(RadianceField, SignedDistance):
    """The ball, a bit to one side."""

    def __init__(self, aside: float) -> None:
        super().__init__()
        self.aside = torch.nn.Parameter(torch.tensor([aside, 0.0, 0.0]))

    def distance(self, positions: Tensor, times: Tensor) -> Tensor:
        return (positions - self.aside).norm(dim=-1) - 0.5

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return 500.0 * (self.distance(positions, times) < 0)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), torch.ones_like(positions))


@pytest.mark.parametrize("aside", [0.0, 0.02])
def test_a_ball_s_volume_distance_and_normals(aside: float) -> None:
    field = Leaning(aside)
    mesh = extract_surface(field, 0.5, box=BOX, resolution=48)
    assert _volume(mesh) == pytest.approx(math.pi / 6, rel=0.01)
    off = SCENE.distance(mesh.vertices, torch.zeros(len(mesh.vertices))).abs().mean()
    assert float(off) == pytest.approx(aside / 2, abs=5e-4)  # the mean of a cosine; vertices lie unevenly
    assert _nearest(mesh.vertices, mesh.vertices) == pytest.approx(0, abs=1e-3)
    assert _nearest(mesh.vertices + 10.0, mesh.vertices) == pytest.approx(300**0.5, rel=0.05)
    camera = Camera(Intrinsics.from_angle(24, 24, 0.5), look_at((3.0, 0.0, 0.0)), 2.0, 4.0)
    feet = torch.nn.functional.normalize(mesh.vertices, dim=-1)[:, 0]  # a ball is seen up to where rays touch it
    assert (_seen(SCENE, mesh.vertices, [camera], 0.5) == (feet > 1 / 6))[(feet - 1 / 6).abs() > 0.01].all()
    angle = _angle(Renderer(field, StratifiedSampler(800)).eval(), SCENE, camera, 0.5)
    assert angle == pytest.approx(0, abs=0.6) if aside == 0 else 0 < angle < math.degrees(0.02 / 0.5)
