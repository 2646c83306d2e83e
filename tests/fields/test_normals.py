"""Normals against those that are known, and images of them through the same renderer."""

import pytest
import torch
from torch import Tensor

from dnerf.core.backgrounds import ConstantBackground
from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.compositing import FieldOutput
from dnerf.deformations import CachedDeformation, Deformation, DisplacementDeformation
from dnerf.fields import DeformedField, NeuSField, RadianceField, normals
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.visualization.frame_outputs import normals_image

BOX = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]


class Ball(NeuSField):
    """The ball that training begins with, and nothing else."""

    def _distance(self, positions: Tensor, raw: Tensor) -> Tensor:
        return super()._distance(positions, 0 * raw)


class Cloud(RadianceField):
    """A density that falls with the distance from the origin."""

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return 30 * torch.exp(-4 * positions.square().sum(-1))

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), torch.zeros_like(positions))


class Sheared(Deformation):
    """Shear that grows with time."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        x, y, z = positions.unbind(-1)
        return torch.stack([x + times * y, y, 2 * z], dim=-1)


def ball(width: float = 5e-3) -> NeuSField:
    return Ball(BOX, (4,), 2, max_rows=256, width=width)


def some_points() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return 2 * torch.rand(2, 50, 3, generator=generator) - 1, torch.rand(2, 50, generator=generator)


@pytest.mark.parametrize("field", [ball(), Cloud()], ids=["distance", "density"])
def test_normals_of_what_is_round_point_outwards(field: RadianceField) -> None:
    positions, times = some_points()
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        found = normals(field, positions, times)
    torch.testing.assert_close(found, torch.nn.functional.normalize(positions, dim=-1))
    assert not found.requires_grad


@pytest.mark.parametrize("canonical", [ball(), Cloud()], ids=["distance", "density"])
def test_normals_are_pulled_back_through_a_deformation(canonical: RadianceField) -> None:
    """By the transposed Jacobian, here known."""
    positions, times = some_points()
    jacobian = torch.eye(3).repeat(2, 50, 1, 1)
    jacobian[..., 0, 1], jacobian[..., 2, 2] = times, 2
    expected = (jacobian.mT @ Sheared()(positions, times)[..., None])[..., 0]
    found = normals(DeformedField(Sheared(), canonical), positions, times)
    torch.testing.assert_close(found, torch.nn.functional.normalize(expected, dim=-1), rtol=0, atol=1e-5)


def test_where_a_field_is_level_there_is_no_normal() -> None:
    class Fog(Cloud):
        def density(self, positions: Tensor, times: Tensor) -> Tensor:
            return 1 + 0 * positions[..., 0]

    assert torch.equal(normals(Fog(), torch.ones(3, 3), torch.zeros(3)), torch.zeros(3, 3))
    assert torch.equal(normals(ball(), torch.zeros(1, 3), torch.zeros(1)), torch.zeros(1, 3))  # the ball's centre


def seen_ball(renderer: Renderer) -> tuple[Tensor, Tensor]:
    """Normals as an image, and those of the ball where the rays meet it; NaN where they miss."""
    camera = Camera(Intrinsics.from_angle(24, 24, 0.7), look_at((0.0, -3.0, 0.5), (0.0, 0.0, 0.0)), 1.0, 5.0)
    image = normals_image(renderer, camera, 0.4)
    rays = camera.rays(0.4)
    middle = -(rays.origins * rays.directions).sum(-1, keepdim=True)
    half = (0.8**2 - (rays.origins + middle * rays.directions).square().sum(-1, keepdim=True)).sqrt()
    return image, ((rays.origins + (middle - half) * rays.directions) / 0.8).reshape(24, 24, 3)


@pytest.mark.parametrize("deformed", [False, True])
def test_the_image_of_normals_is_that_of_the_surface(deformed: bool) -> None:
    """Also where the frame's own deformation is a lattice, which has no derivatives."""
    field: RadianceField = ball()
    if deformed:
        motion = DisplacementDeformation(1, 8, (), position_frequencies=2, time_frequencies=2)
        field = DeformedField(CachedDeformation(motion, BOX, 8), field)
    renderer = Renderer(field, StratifiedSampler(300, BOX), ConstantBackground("white"))
    image, exact = seen_ball(renderer)
    hit = exact.isfinite().all(-1)
    facing = hit & (exact[..., 1] < -0.5)
    assert facing.sum() > 50
    degrees = torch.rad2deg(torch.acos((image * exact).sum(-1).clamp(max=1)))[facing]
    assert degrees.max() < 1  # the layer that absorbs is 5e-3 thick
    assert image[~hit].norm(dim=-1)[0] == 0  # the corner


def test_exact_scenes_have_exact_distances_and_normals() -> None:
    """The distance is that to the nearest of many places on the surface, found by bisection."""
    scene = make_scene("snowman").double()
    generator = torch.Generator().manual_seed(0)
    box = scene.box.double()
    places = torch.lerp(box[0], box[1], torch.rand(40, 3, generator=generator, dtype=torch.float64))
    times = torch.full((40,), 0.3, dtype=torch.float64)
    distance = scene.distance(places, times)
    assert torch.equal(distance <= 0, scene.contains(places, times).any(-1))
    stepped = places - distance[:, None] * normals(scene, places, times)
    on_surface = scene.distance(stepped, times).abs()[distance > 0]  # the nearest place lies straight ahead
    assert len(on_surface) > 20
    assert on_surface.max() < 1e-9
