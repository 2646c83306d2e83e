"""The temporal-consistency suite: exact scenes pass, pairs of deformation and field pass, broken ones fail.

A new pair is one line in `subjects.PAIRS`.
"""

from collections.abc import Callable

import pytest
import torch
from subjects import (
    BOX,
    NUM_SLABS,
    PAIRS,
    TRAIN_FRAMES,
    Retimed,
    Shifted,
    Tinted,
    camera_rays,
    eight_steps,
    exact,
    fade,
    fitted,
    flicker,
    jump,
    trained,
    with_occupancy,
)
from torch import Tensor

from dnerf.compositing import FieldOutput
from dnerf.consistency import (
    LEVEL,
    SHARP,
    SMOOTH,
    Finding,
    check_canonical_identity,
    check_closing,
    check_colour_along_tracks,
    check_continuity,
    check_popping,
    check_static,
    check_unseen_times,
    pictures_over_time,
    seeing_rays,
)
from dnerf.deformations import DisplacementDeformation, IdentityDeformation
from dnerf.fields import DeformedField
from dnerf.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import SCENES, make_scene

RAYS = camera_rays()
EXACT_RAYS = RAYS.to(torch.float64)
BOUNDARIES = [k / NUM_SLABS for k in range(1, NUM_SLABS)]
TRAIN_TIMES = torch.linspace(0, 1, TRAIN_FRAMES).tolist()
WEBER = 0.01
"""Smallest relative step of brightness that people see (Weber's fraction is 1 to 2 %): what may pop, on average, behind
a sampler that drops thin haze in one slab of time and shows it in the next."""

JUMP_ORDER = 0.05
"""A jump's order is 0; by the smallest step, motion adds about 2^-10 of the jump to it."""

ROUNDING = 1e-5
"""A hundred times the rounding of colours in single precision."""

MARGIN = 2.0
"""What is broken on purpose misses the bounds by this factor at least."""

CORRELATED = 0.5
"""Most change of what should stand still, as a share of two errors: sqrt((1 - r) / 2), where they correlate by r = 1/2.
Errors of frames that know nothing of each other have 0.71."""

JUMPING = ["jumping_ball", "vanishing_ball"]
"""Scenes that are discontinuous in time by design; a smooth pair fitted to them is smooth all the same."""

CHANGING = ["merging_balls", "pulsing_fog", "vanishing_ball"]
"""Scenes whose matter changes: colours mix where balls merge, fog thins as it grows, what vanishes has no colour."""

every_scene = pytest.mark.parametrize("scene", sorted(SCENES))
moving_scenes = pytest.mark.parametrize("scene", sorted(SCENES.keys() - {"static"}))
every_pair = pytest.mark.parametrize("pair", sorted(PAIRS))


def checked(finding: Finding) -> None:
    assert finding.passed, str(finding)


def refused(finding: Finding) -> None:
    assert not finding.passed, str(finding)


def jumps(finding: Finding) -> None:
    """Not continuous, and by far: the order is that of a jump."""
    refused(finding)
    assert abs(finding.value) < JUMP_ORDER, str(finding)


def pops(finding: Finding, margin: float = MARGIN) -> None:
    """Above its bound, and by far."""
    refused(finding)
    assert finding.value > margin * finding.bound, str(finding)


# Exact scenes pass: the checks are not too strict.


@pytest.mark.parametrize("scene", sorted(SCENES.keys() - set(JUMPING)))
def test_exact_scenes_are_continuous(scene: str) -> None:
    # 2^-25 of the time: not before does a single ray, the one that has just met an edge, change most.
    checked(check_continuity(exact(scene), EXACT_RAYS, num_halvings=20, least_order=SHARP))


@pytest.mark.parametrize("scene", JUMPING)
def test_exact_scenes_that_jump_are_found_out(scene: str) -> None:
    jumps(check_continuity(exact(scene), EXACT_RAYS, num_halvings=20, least_order=SHARP))


@every_scene
def test_exact_scenes_do_not_pop(scene: str) -> None:
    checked(check_popping(exact(scene), RAYS, BOUNDARIES))


@every_scene
def test_exact_scenes_close(scene: str) -> None:
    checked(check_static(exact(scene), RAYS, most=ROUNDING, num_times=2))


@pytest.mark.parametrize("scene", sorted(SCENES.keys() - set(CHANGING)))
def test_exact_matter_keeps_its_colour(scene: str) -> None:
    checked(check_colour_along_tracks(exact(scene), RAYS, most=ROUNDING))


@pytest.mark.parametrize("scene", CHANGING)
def test_exact_matter_that_changes_is_found_out(scene: str) -> None:
    refused(check_colour_along_tracks(exact(scene), RAYS, most=MARGIN * LEVEL))


@every_scene
def test_exact_scenes_are_right_between_training_times(scene: str) -> None:
    checked(check_unseen_times(exact(scene), exact(scene), RAYS, TRAIN_TIMES))


def test_the_exact_static_scene_is_static() -> None:
    checked(check_static(exact("static"), RAYS, most=0.0))


# Pairs of a deformation and a canonical field pass, on every scene.


@every_pair
@every_scene
def test_pairs_are_continuous(pair: str, scene: str) -> None:
    checked(check_continuity(fitted(pair, scene), RAYS, num_times=17, least_order=SMOOTH))


@every_pair
@every_scene
def test_pairs_do_not_pop_at_slabs(pair: str, scene: str) -> None:
    checked(check_popping(with_occupancy(fitted(pair, scene)), RAYS, BOUNDARIES))


@every_pair
@every_scene
def test_pairs_leave_canonical_space_alone(pair: str, scene: str) -> None:
    deformation = fitted(pair, scene).field.deformation
    checked(check_canonical_identity(deformation, deformation.canonical_time, torch.tensor(BOX)))


@every_pair
@every_scene
def test_pairs_keep_colours_along_tracks(pair: str, scene: str) -> None:
    checked(check_colour_along_tracks(fitted(pair, scene), RAYS))


@every_pair
@every_scene
def test_pairs_are_no_worse_between_training_times(pair: str, scene: str) -> None:
    checked(check_unseen_times(fitted(pair, scene), exact(scene), RAYS, TRAIN_TIMES))


@every_pair
@every_scene
def test_pairs_close_where_the_motion_does(pair: str, scene: str) -> None:
    checked(check_closing(fitted(pair, scene), RAYS, exact(scene)))


@every_pair
def test_an_untrained_pair_is_static(pair: str) -> None:
    deformation, _ = PAIRS[pair]()
    frozen = Retimed(make_scene("walker"), torch.zeros_like)
    renderer = Renderer(DeformedField(deformation, frozen), StratifiedSampler(48, BOX))
    checked(check_static(renderer, RAYS, most=0.0))


@pytest.mark.slow
@every_pair
@every_scene
def test_trained_pairs_pass_the_whole_suite(pair: str, scene: str) -> None:
    renderer = trained(pair, scene)
    steady = Renderer(renderer.field, StratifiedSampler(48, BOX))
    findings = [
        check_continuity(steady, RAYS, least_order=SMOOTH),
        check_popping(steady, RAYS, BOUNDARIES),
        check_popping(renderer, RAYS, BOUNDARIES, most=WEBER),
        check_canonical_identity(renderer.field.deformation, 0.0, torch.tensor(BOX)),
        check_colour_along_tracks(renderer, RAYS),
        check_unseen_times(renderer, exact(scene), RAYS, TRAIN_TIMES),
    ]
    if scene == "static":
        findings.append(check_static(renderer, RAYS, truth=exact(scene), most=CORRELATED))
    else:
        findings.append(check_closing(renderer, RAYS, exact(scene)))
    assert all(finding.passed for finding in findings), "\n".join(map(str, findings))


# What is broken on purpose fails: each check can.


def retimed(renderer: Renderer, clock: Callable[[Tensor], Tensor]) -> Renderer:
    return Renderer(Retimed(renderer.field, clock), StratifiedSampler(48, BOX))


def tinted(renderer: Renderer, tint: Callable[[Tensor], Tensor]) -> Renderer:
    return Renderer(Tinted(renderer.field, tint), renderer.sampler)


def shifted(renderer: Renderer, shift: Callable[[Tensor], Tensor]) -> Renderer:
    field = renderer.field
    return Renderer(DeformedField(Shifted(field.deformation, shift), field.canonical), renderer.sampler)


@moving_scenes
def test_time_in_eight_steps_is_not_continuous(scene: str) -> None:
    model = retimed(fitted("displacement", scene), eight_steps)
    jumps(check_continuity(model, RAYS))
    # Fog hides what moves in it: all that changes in an eighth of the time is half a level.
    if scene != "dense_fog":
        pops(check_popping(model, RAYS, BOUNDARIES))


@every_scene
def test_a_flickering_colour_is_not_continuous(scene: str) -> None:
    model = fitted("displacement", scene)
    jumps(check_continuity(tinted(model, flicker), RAYS))
    canonical = DeformedField(model.field.deformation, Tinted(model.field.canonical, flicker))
    pops(check_colour_along_tracks(Renderer(canonical, model.sampler), RAYS))


def test_a_flickering_lamp_is_not_static() -> None:
    lit = tinted(exact("static"), flicker)
    pops(check_static(lit, RAYS, most=LEVEL))
    pops(check_static(lit, RAYS, truth=exact("static"), most=CORRELATED), 1.2)


def test_a_fading_colour_is_continuous_but_not_the_same_along_tracks() -> None:
    model = DeformedField(
        fitted("displacement", "walker").field.deformation,
        Tinted(fitted("displacement", "walker").field.canonical, fade),
    )
    renderer = Renderer(model, StratifiedSampler(48, BOX))
    checked(check_continuity(renderer, RAYS, least_order=SMOOTH))
    refused(check_colour_along_tracks(renderer, RAYS))


@every_scene
def test_a_deformation_that_jumps_is_not_continuous(scene: str) -> None:
    model = shifted(fitted("displacement", scene), jump)
    jumps(check_continuity(model, RAYS))
    checked(check_popping(model, RAYS, BOUNDARIES))  # it jumps elsewhere: only the search finds it
    pops(check_popping(model, RAYS, [0.53]))


def test_a_sampler_that_forgets_a_slab_pops() -> None:
    model = with_occupancy(fitted("displacement", "pulsing_fog"))
    remembered = model.sampler.occupied.clone()
    remembered[3] = False
    model.sampler.occupy(remembered)
    refused(check_popping(model, RAYS, BOUNDARIES))


@pytest.mark.parametrize("offset", [1e-6, 0.1])
def test_a_deformation_that_moves_canonical_space_is_found(offset: float) -> None:
    moved = Shifted(IdentityDeformation(), lambda times: offset + 0 * times)
    refused(check_canonical_identity(moved, 0.0, torch.tensor(BOX)))
    loose = DisplacementDeformation(2, 8, (), canonical_time=None)
    with torch.no_grad():
        loose.mlp.output.bias.fill_(offset)
    refused(check_canonical_identity(loose, 0.0, torch.tensor(BOX)))


def test_points_in_fog_are_followed_too() -> None:
    """Fog is nowhere dense; a check that looked at opaque points alone would have nothing to look at, and pass."""
    model = fitted("displacement", "pulsing_fog")
    faded = DeformedField(model.field.deformation, Tinted(model.field.canonical, fade))
    pops(check_colour_along_tracks(Renderer(faded, model.sampler), RAYS))


def test_tracks_of_nothing_are_refused() -> None:
    class Late(Retimed):
        def density(self, positions: Tensor, times: Tensor) -> Tensor:
            return (times > 0.5) * super().density(positions, times)

        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            rgb = super().forward(positions, directions, times).rgb
            return FieldOutput(self.density(positions, times), rgb)

    late = Renderer(Late(make_scene("static"), torch.clone), StratifiedSampler(48, BOX))
    with pytest.raises(ValueError, match="rays must see matter at the start"):
        check_colour_along_tracks(late, RAYS)


def test_too_few_halvings_are_refused() -> None:
    with pytest.raises(ValueError, match="num_halvings must be at least 8, got 7"):
        check_continuity(exact("static"), RAYS, num_halvings=7)


def test_motion_that_stops_early_does_not_close() -> None:
    scene = exact("orbiting_balls")
    model = Renderer(Retimed(scene.field, lambda times: 0.75 * times), StratifiedSampler(256, BOX))
    refused(check_closing(model, RAYS, scene))


def test_memorised_training_times_are_worse_in_between() -> None:
    """Exact at eight training times, and nowhere else: the error between them is all there is."""
    scene = exact("orbiting_balls")
    known = [k / 8 for k in range(8)]
    sampler = StratifiedSampler(256, BOX)
    exactly, quantised = (Renderer(field, sampler) for field in (scene.field, Retimed(scene.field, eight_steps)))
    checked(check_unseen_times(exactly, exactly, RAYS, known))
    refused(check_unseen_times(quantised, exactly, RAYS, known))


def test_matter_without_a_motion_is_found_out() -> None:
    """Canonical space folded onto a plane: no inverse exists, so no track can be followed."""

    class Folded(DisplacementDeformation):
        def forward(self, positions: Tensor, times: Tensor) -> Tensor:
            start = (times == 0)[..., None]
            return torch.where(start, positions, positions * torch.tensor([1.0, 1.0, 0.0]))

    canonical = fitted("displacement", "walker").field.canonical
    model = Renderer(DeformedField(Folded(1, 8, ()), canonical), StratifiedSampler(48, BOX))
    finding = check_colour_along_tracks(model, RAYS)
    refused(finding)
    assert "motion is found" in finding.meaning


def test_pictures_over_time_are_the_renderers_at_each_time() -> None:
    renderer = exact("walker")
    times = torch.tensor([0.1, 0.6, 0.9])
    colors, opacity = pictures_over_time(renderer, RAYS, times, chunk=500)
    for i, time in enumerate(times):
        rendering = renderer(type(RAYS)(RAYS.origins, RAYS.directions, 0 * RAYS.times + time, RAYS.near, RAYS.far))
        torch.testing.assert_close(colors[i], rendering.rgb, rtol=0, atol=1e-6)
        torch.testing.assert_close(opacity[i], rendering.opacity, rtol=0, atol=1e-6)


def test_rays_that_see_nothing_are_refused() -> None:
    away = type(RAYS)(RAYS.origins, -RAYS.directions, RAYS.times, RAYS.near, RAYS.far)
    with pytest.raises(ValueError, match="rays must see matter"):
        seeing_rays(exact("static"), away)


def test_findings_read_as_a_line() -> None:
    assert str(Finding("no popping", 0.5, LEVEL, False, "change")) == (
        "no popping: FAILED (change: 0.5, bound 0.00392)"
    )
