"""Consistency over time: exact scenes pass, fitted models pass, models broken on purpose fail."""

import math
from collections.abc import Callable
from functools import cache

import pytest
import torch
from reference import exact
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.compositing import FieldOutput, Rendering
from dnerf.core.rays import Rays
from dnerf.data import render_exact
from dnerf.deformations import Deformation, DisplacementDeformation, IdentityDeformation
from dnerf.evaluation import Finding, check_consistency
from dnerf.evaluation import consistency as checks
from dnerf.fields import DeformedField, GridField, RadianceField
from dnerf.motion import motion_model
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import SCENES, AnalyticScene, make_scene

BOX = ((-1.35, -1.35, -1.0), (1.35, 1.35, 1.0))
RAYS = Camera(Intrinsics.from_angle(10, 10, 0.6), look_at((3.5, 0.6, 1.7))).rays(0.0)
EXACT_RAYS = RAYS.to(torch.float64)  # in which tiny steps of time are what they say
BOUNDARIES = [k / 8 for k in range(1, 8)]
TRAIN_TIMES = torch.linspace(0, 1, 40).tolist()
REACH = 0.5

JUMP_ORDER = 0.05
"""A jump's order is 0; by the smallest step, motion adds about 2^-10 of the jump to it."""

ROUNDING = 1e-5
"""A hundred times the rounding of colours in single precision."""

JUMPING = ["jumping_ball", "vanishing_ball"]
"""Scenes that are discontinuous in time by design; a smooth model fitted to them is smooth all the same."""

CHANGING = ["merging_balls", "pulsing_fog", "vanishing_ball"]
"""Scenes whose density changes: colours mix where balls merge, fog thins as it grows, what vanishes has no colour."""

# The rod is too thin for any of these rays.
every_scene = pytest.mark.parametrize("scene", sorted(SCENES.keys() - {"thin_rod"}))
some_scenes = pytest.mark.parametrize("scene", ["walker", "pulsing_fog", "jumping_ball"])


def exact_images(name: str) -> Callable[[Rays], Rendering]:
    scene = make_scene(name)
    return lambda rays: Rendering(*render_exact(scene, rays, rays.origins.new_ones(3)))


def training_points(scene: AnalyticScene, count: int = 1 << 16) -> Tensor:
    """Random points at training times, as many inside as near and far: position, time, hidden share, rgb."""
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(BOX)
    positions = torch.lerp(low, high, torch.rand(count, 3, generator=generator))
    times = torch.tensor(TRAIN_TIMES)[torch.randint(len(TRAIN_TIMES), (count,), generator=generator)]
    truth = scene(positions, torch.nn.functional.normalize(-positions, dim=-1), times)
    hidden = 1 - torch.exp(-REACH * truth.density)
    rows = torch.cat([positions, times[:, None], hidden[:, None], truth.rgb], dim=-1)
    inside, outside = rows[hidden > 0], rows[hidden == 0]
    return torch.cat([inside.repeat(max(1, len(outside) // (3 * len(inside))), 1), outside])


@cache
def fitted(scene_name: str, num_steps: int = 80) -> Renderer:
    """A model fitted to an exact scene: seeded regression on density and colour at random points and times.

    A second of it gives one that moves in earnest, though roughly: enough for checks of how it moves rather than
    whether it is right. Densities are compared by what they hide over half a unit.
    """
    torch.manual_seed(0)
    deformation = DisplacementDeformation(3, 48, (), position_frequencies=3, time_frequencies=4, canonical_time=0.0)
    canonical = GridField(BOX, (16, 32, 64), 4, max_rows=1 << 16, hidden_features=32, num_layers=1)
    field, points = DeformedField(deformation, canonical), training_points(make_scene(scene_name))
    groups = [{"params": deformation.parameters(), "lr": 6e-3}, {"params": canonical.parameters(), "lr": 2e-2}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.05 ** (1 / num_steps))
    generator = torch.Generator().manual_seed(0)
    for _ in range(num_steps):
        chosen = torch.randint(len(points), (2048,), generator=generator)
        positions, times, true_hidden, true_rgb = points[chosen].split([3, 1, 1, 3], dim=-1)
        output = field(positions, torch.zeros_like(positions), times[:, 0])
        hidden = 1 - torch.exp(-REACH * output.density)
        loss = (hidden - true_hidden[:, 0]).square().mean() + (true_hidden * (output.rgb - true_rgb).square()).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return Renderer(field.requires_grad_(False), StratifiedSampler(48, BOX)).eval()


Change = Callable[[Tensor], Tensor]


class Altered(RadianceField):
    """A field at other times, in other colours."""

    def __init__(self, field: RadianceField, clock: Change = torch.clone, tint: Change = torch.ones_like) -> None:
        super().__init__()
        self.field, self.clock, self.tint = field, clock, tint

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.field.density(positions, self.clock(times))

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        output = self.field(positions, directions, self.clock(times))
        return FieldOutput(output.density, output.rgb * self.tint(times)[..., None], output.extras)


class Jumping(Deformation):
    """A deformation that shifts everything by 0.15 units from t = 0.53 on."""

    def __init__(self, deformation: Deformation) -> None:
        super().__init__()
        self.deformation = deformation

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.deformation(positions, times) + 0.15 * (times > 0.53)[..., None]


class Folded(DisplacementDeformation):
    """Canonical space folded onto a plane: no inverse exists."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return torch.where((times == 0)[..., None], positions, positions * torch.tensor([1.0, 1.0, 0.0]))


def eight_steps(times: Tensor) -> Tensor:
    return (8 * times).floor().clamp(max=7) / 8


def flicker(times: Tensor) -> Tensor:
    """A lamp that goes up and down by 10 % at once, 37 times."""
    return 0.9 + 0.1 * torch.sign(torch.sin(2 * torch.pi * 37 * times))


def fade(times: Tensor) -> Tensor:
    return 1 - 0.3 * times


def altered(renderer: Renderer, **changes: Change) -> Renderer:
    return Renderer(Altered(renderer.field, **changes), StratifiedSampler(48, BOX)).eval()


def along_tracks(renderer: Renderer, **options: float) -> Finding:
    motion = motion_model(renderer)
    assert motion is not None
    return checks.check_colour_along_tracks(renderer, motion, RAYS, **options)


def checked(finding: Finding) -> None:
    assert finding.passed, str(finding)


def refused(finding: Finding, factor: float = 1.0) -> None:
    """Beyond its bound, by a factor."""
    assert finding.passed is False, str(finding)
    assert finding.value is not None
    assert finding.value > factor * finding.bound, str(finding)


def jumps(finding: Finding) -> None:
    assert finding.passed is False, str(finding)
    assert finding.value is not None
    assert abs(finding.value) < JUMP_ORDER, str(finding)


# Exact scenes pass: the checks are not too strict.


@every_scene
def test_exact_scenes_are_continuous_but_for_those_that_jump(scene: str) -> None:
    # 2^-25 of the time: not before does a single ray, the one that has just met an edge, change most.
    finding = checks.check_continuity(exact_images(scene), EXACT_RAYS, num_halvings=20, least_order=checks.SHARP)
    jumps(finding) if scene in JUMPING else checked(finding)


@every_scene
def test_exact_scenes_neither_pop_nor_end_elsewhere_nor_miss_times(scene: str) -> None:
    images = exact_images(scene)
    checked(checks.check_popping(images, RAYS, BOUNDARIES))
    checked(checks.check_closing(images, RAYS, images))
    checked(checks.check_unseen_times(images, images, RAYS, TRAIN_TIMES))


@every_scene
def test_exact_points_keep_their_colour_unless_they_change(scene: str) -> None:
    if scene in CHANGING:
        refused(along_tracks(exact(make_scene(scene)), most=2 * checks.LEVEL))
    else:
        checked(along_tracks(exact(make_scene(scene)), most=ROUNDING))


# Fitted models pass.


@some_scenes
def test_all_checks_of_a_fitted_model_pass(scene: str) -> None:
    model = fitted(scene)
    checked(checks.check_continuity(model, RAYS, num_times=17, least_order=checks.SMOOTH))
    model.train()
    findings = check_consistency(model, RAYS, BOX, slabs=8, truth=exact_images(scene), train_times=TRAIN_TIMES)
    assert model.training
    model.eval()
    names = ["time continuity", "no popping", "colour along tracks", "periodic motion", "unseen times"]
    assert [finding.check for finding in findings] == names
    assert all(finding.passed for finding in findings), "\n".join(map(str, findings))


def test_only_what_can_be_checked_is() -> None:
    unknown = altered(fitted("walker"))
    assert [finding.check for finding in check_consistency(unknown, RAYS, BOX)] == ["time continuity"]


# What is broken on purpose fails: each check can.


@some_scenes
def test_time_in_eight_steps_jumps(scene: str) -> None:
    model = altered(fitted(scene), clock=eight_steps)
    jumps(checks.check_continuity(model, RAYS))
    refused(checks.check_popping(model, RAYS, BOUNDARIES), 2)


@some_scenes
def test_a_flickering_colour_jumps(scene: str) -> None:
    model = fitted(scene)
    jumps(checks.check_continuity(altered(model, tint=flicker), RAYS))
    canonical = Altered(model.field.canonical, tint=flicker)
    refused(along_tracks(Renderer(DeformedField(model.field.deformation, canonical), model.sampler).eval()), 2)


@pytest.mark.parametrize("scene", ["walker", "pulsing_fog"])
def test_a_fading_colour_is_continuous_but_not_the_same_along_tracks(scene: str) -> None:
    """Fog, too, is followed: a check that looked at opaque points alone would have nothing to look at, and pass."""
    model = fitted(scene)
    faded = DeformedField(model.field.deformation, Altered(model.field.canonical, tint=fade))
    renderer = Renderer(faded, model.sampler).eval()
    checked(checks.check_continuity(renderer, RAYS, least_order=checks.SMOOTH))
    refused(along_tracks(renderer), 2)


@some_scenes
def test_a_deformation_that_jumps_is_found_by_search(scene: str) -> None:
    field = fitted(scene).field
    model = Renderer(DeformedField(Jumping(field.deformation), field.canonical), StratifiedSampler(48, BOX)).eval()
    jumps(checks.check_continuity(model, RAYS))
    checked(checks.check_popping(model, RAYS, BOUNDARIES))  # it jumps elsewhere
    refused(checks.check_popping(model, RAYS, [0.53]), 2)


def test_motion_that_stops_early_does_not_close() -> None:
    scene = make_scene("orbiting_balls")
    model = Renderer(Altered(scene, clock=lambda times: 0.75 * times), StratifiedSampler(256, BOX)).eval()
    refused(checks.check_closing(model, RAYS, exact_images("orbiting_balls")))


def test_memorised_training_times_are_worse_in_between() -> None:
    scene, sampler = make_scene("orbiting_balls"), StratifiedSampler(256, BOX)
    exactly, quantised = (Renderer(field, sampler) for field in (scene, Altered(scene, clock=eight_steps)))
    known = [k / 8 for k in range(8)]
    checked(checks.check_unseen_times(exactly, exactly, RAYS, known))
    refused(checks.check_unseen_times(quantised, exactly, RAYS, known))


def test_points_whose_motion_is_lost_are_found_out() -> None:
    model = Renderer(DeformedField(Folded(1, 8, ()), fitted("walker").field.canonical), StratifiedSampler(48, BOX))
    finding = along_tracks(model.eval())
    assert finding.passed is False
    assert "motion is found" in finding.meaning


# What cannot be measured is no success.


def test_what_is_not_measured_neither_passes_nor_fails_and_findings_read_as_a_line() -> None:
    class Late(Altered):
        """Nothing until halfway."""

        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            output = super().forward(positions, directions, times)
            return FieldOutput((times > 0.5) * output.density, output.rgb)

    empty = Renderer(Late(make_scene("static")), StratifiedSampler(48, BOX)).eval()
    nothing = checks.check_colour_along_tracks(empty, IdentityDeformation(), RAYS)
    assert (nothing.value, nothing.passed) == (None, None)
    late = Renderer(Altered(make_scene("walker"), clock=lambda times: 0.3 * times), StratifiedSampler(48, BOX)).eval()
    open_ended = checks.check_closing(late, RAYS, late)
    assert (open_ended.value, open_ended.passed) == (None, None)
    assert "not measured" in str(open_ended)
    line = str(Finding("no popping", 0.5, checks.LEVEL, False, "change"))
    assert line.split() == ["no", "popping", "FAILED", "0.5", "0.00392", "change"]
    assert "inf" in str(Finding("time continuity", math.inf, checks.SHARP, True, "order"))


def test_rays_that_show_nothing_and_too_few_halvings_are_refused() -> None:
    away = Rays(RAYS.origins, -RAYS.directions, RAYS.times, RAYS.near, RAYS.far)
    with pytest.raises(ValueError, match="rays must show something"):
        checks.hitting_rays(exact_images("static"), away)
    with pytest.raises(ValueError, match="num_halvings must be at least 8, got 7"):
        checks.check_continuity(exact_images("static"), RAYS, num_halvings=7)


def test_images_over_time_are_the_renderers_at_each_time() -> None:
    renderer, times = exact(make_scene("walker")), torch.tensor([0.1, 0.6, 0.9])
    colors, opacity = checks.images_over_time(renderer, RAYS, times, chunk=500)
    for i, time in enumerate(times):
        rendering = renderer(Rays(RAYS.origins, RAYS.directions, 0 * RAYS.times + time, RAYS.near, RAYS.far))
        torch.testing.assert_close(colors[i], rendering.rgb, rtol=0, atol=1e-6)
        torch.testing.assert_close(opacity[i], rendering.opacity, rtol=0, atol=1e-6)
