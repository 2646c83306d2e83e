"""Sphere tracing against exact surfaces, and against the volume that becomes them."""

import logging
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from dnerf.core.backgrounds import ConstantBackground
from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.rays import Rays
from dnerf.deformations import Deformation
from dnerf.fields import DeformedField, GridField, NeuSField, VolSDFField
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import SphereTracingSampler, StratifiedSampler, sphere_tracing

BOX = [[-1.3, -1.3, -1.3], [1.3, 1.3, 1.3]]
CAMERA = Camera(Intrinsics.from_angle(32, 32, 0.7), look_at((0.5, -3.0, 0.8), (0.0, 0.0, 0.0)), 1.0, 6.0)


def field_like_trained(kind: type = NeuSField, width: float = 0.05) -> NeuSField:
    """A ball with dents, whose gradient is not of length one everywhere."""
    torch.manual_seed(0)
    field = kind(BOX, (4, 8), 2, max_rows=1024, hidden_features=16, num_layers=1, radius=0.7, width=width)
    with torch.no_grad():
        field.table.mul_(30)
    return field.requires_grad_(False).eval()


class Squeezed(Deformation):
    """A body that is flat in the world: distance grows three times as fast along z, and bends with time."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        x, y, z = positions.unbind(-1)
        return torch.stack([x, y, 3 * z + times * torch.sin(2 * x)], dim=-1)


def first_zero(field: NeuSField, rays: Rays) -> Tensor:
    """Where rays first come inside, in steps of 5e-4; NaN if they do not."""
    t = torch.arange(1.0, 6.0, 5e-4)
    hits = torch.full((len(rays),), torch.nan)
    for i in range(len(rays)):
        positions = rays.origins[i] + t[:, None] * rays.directions[i]
        is_inside = field.distance(positions, rays.times[i].expand(len(t))) < 0
        numbers = (is_inside & (positions.abs() < 1.3).all(-1)).nonzero()
        if len(numbers):
            hits[i] = t[int(numbers[0])]
    return hits


@pytest.mark.parametrize("deformed", [False, True])
def test_hits_are_where_rays_first_come_inside(deformed: bool) -> None:
    field = field_like_trained()
    field = DeformedField(Squeezed(), field) if deformed else field
    rays = CAMERA.rays(0.6)[torch.arange(0, 1024, 7)]
    samples = SphereTracingSampler(BOX)(rays, field)
    found = torch.full((len(rays),), torch.nan).scatter(0, samples.ray_indices, samples.points)
    expected = first_zero(field, rays)
    assert (found.isnan() == expected.isnan()).float().mean() > 0.98  # grazing rays may do either
    both = ~(found.isnan() | expected.isnan())
    assert both.sum() > 30
    assert (~both).sum() > 30
    error = (found - expected)[both].abs()
    assert error.quantile(0.95) < 1e-3  # of steps of 5e-4, at an angle
    assert torch.equal(samples.ray_indices, samples.ray_indices.unique())


def test_a_bound_on_the_stretch_keeps_steps_out_of_flat_bodies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it a step of the canonical distance leaps through a body that is thin in the world."""

    class Flat(Deformation):
        def forward(self, positions: Tensor, times: Tensor) -> Tensor:
            return positions * torch.tensor([1.0, 1.0, 40.0])

    x = torch.linspace(-0.4, 0.4, 50)
    origins = torch.stack([x, 0 * x, 1.2 + 0 * x], dim=-1)
    rays = Rays(origins, torch.tensor([0.0, 0, -1]).expand(50, 3), 0 * x, 0 * x, 2.4 + 0 * x)
    sampler, field = SphereTracingSampler(BOX, num_steps=1000), DeformedField(Flat(), field_like_trained())
    assert len(sampler(rays, field).starts) == 50
    monkeypatch.setattr(sphere_tracing, "differences", lambda surface, positions, *_: torch.zeros_like(positions))
    assert len(sampler(rays, field).starts) < 50


@pytest.mark.parametrize("kind", [NeuSField, VolSDFField])
@pytest.mark.parametrize("deformed", [False, True])
def test_the_volume_becomes_the_surface_as_it_sharpens(kind: type, deformed: bool) -> None:
    errors = []
    for width in (0.04, 0.01, 0.0025):
        field = field_like_trained(kind, width)
        field = DeformedField(Squeezed(), field) if deformed else field
        white = ConstantBackground("white")
        surface = Renderer(field, SphereTracingSampler(BOX), white).render_image(CAMERA, 0.6)
        volume = Renderer(field, StratifiedSampler(1500, torch.tensor(BOX)), white).render_image(CAMERA, 0.6)
        assert set(surface.opacity.unique().tolist()) == {0.0, 1.0}
        both = (surface.opacity == 1) & (volume.opacity > 0.99)
        assert both.sum() > 50
        errors.append(((surface.rgb - volume.rgb).abs().mean(), (surface.depth - volume.depth)[both].abs().mean()))
    for before, after in pairwise(errors):
        assert all(b < 0.5 * a for a, b in zip(before, after, strict=True))  # in proportion to the width: a quarter
    assert errors[-1][1] < 0.01


def test_rays_of_every_kind(caplog: pytest.LogCaptureFixture) -> None:
    """From inside, beginning at the surface's far side, empty, away; and no rays at all."""
    field, down = field_like_trained(), [0.0, 0.0, -1.0]
    origins = torch.tensor([[0.0, 0, 0], [0, 0, 3], [0, 0, 3], [0, 0, 3], [5, 5, 5]])
    directions = torch.tensor([down, down, down, [0.0, 0, 1], down])
    near, far = torch.tensor([0.0, 0, 2, 0, 0]), torch.tensor([6.0, 6, 2, 6, 6])
    sampler = SphereTracingSampler(BOX)
    samples = sampler(Rays(origins, directions, 0 * near, near, far), field)
    assert samples.ray_indices.tolist() == [0, 1]
    assert samples.starts[0] == 0
    assert (samples.ends > samples.starts).all()
    empty = torch.zeros(0)
    none = sampler(Rays(empty.reshape(0, 3), empty.reshape(0, 3), empty, empty, empty), field)
    assert len(none.starts) == 0
    assert not caplog.records


def test_a_surface_in_the_last_step_before_far_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The step goes beyond both: as where the steepest place is none of those that were probed."""
    field, ray = field_like_trained(), CAMERA.rays(0.6)[torch.tensor([528])]
    hit = first_zero(field, ray)
    monkeypatch.setattr(SphereTracingSampler, "_probe", lambda *_: (torch.ones(1), torch.tensor(1e-3)))
    samples = SphereTracingSampler(BOX)(replace(ray, far=hit + 0.01), field)
    assert (samples.points - hit).abs().max() < 1e-3  # of steps of 5e-4
    assert len(SphereTracingSampler(BOX)(replace(ray, far=hit - 0.01), field).starts) == 0


@pytest.mark.parametrize("at_probes", [False, True])
def test_distances_that_are_nan_are_no_rays_that_miss(at_probes: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    field = field_like_trained()
    if at_probes:
        monkeypatch.setattr(sphere_tracing, "differences", lambda surface, positions, *_: positions * torch.nan)
    else:  # at none of the probes, as a place that only some rays come to
        monkeypatch.setattr(SphereTracingSampler, "_probe", lambda *_: (torch.ones(1), torch.ones(())))
        monkeypatch.setattr(field, "distance", lambda positions, times: torch.where(times > 0, torch.nan, 0.5 + times))
    with pytest.raises(FloatingPointError, match="the signed distance is NaN"):
        SphereTracingSampler(BOX)(CAMERA.rays(0.6), field)


def test_a_distance_without_a_zero_is_named_once(caplog: pytest.LogCaptureFixture) -> None:
    field = field_like_trained()
    field.radius = -1.0
    sampler, rays = SphereTracingSampler(BOX), CAMERA.rays(0.5)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert len(sampler(rays, field).starts) == 0
    assert len(caplog.messages) == 1
    assert caplog.messages[0].startswith("no ray meets a surface: the signed distance in the box is above ")


def test_a_field_without_a_surface_is_refused() -> None:
    with pytest.raises(ValueError, match="sphere tracing needs a field with a signed distance, got GridField"):
        SphereTracingSampler(BOX)(CAMERA.rays(0.0), GridField(BOX, (4,), 2, max_rows=1024))
    with pytest.raises(ValueError, match=r"safety must be at least 1, got 0\.5"):
        SphereTracingSampler(BOX, safety=0.5)
