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

from dnerf.consistency import (
    LEVEL,
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
from dnerf.scenes import make_scene

RAYS = camera_rays()
EXACT_RAYS = RAYS.to(torch.float64)
BOUNDARIES = [k / NUM_SLABS for k in range(1, NUM_SLABS)]
TRAIN_TIMES = torch.linspace(0, 1, TRAIN_FRAMES).tolist()
SHARP, SMOOTH = 0.4, 0.9
"""Least orders of continuity: bodies with edges have 1/2, networks 1; estimates from five halvings are good to 0.1."""

JUMPING = ["jumping_ball", "vanishing_ball"]
"""Scenes that are discontinuous in time by design: nothing smooth can follow them."""

CHANGING = ["merging_balls", "vanishing_ball"]
"""Scenes whose matter changes: colours mix where balls merge, and what vanishes has none."""

everyday_scenes = pytest.mark.parametrize("scene", ["glossy_ball", "orbiting_balls", "pulsing_fog", "static", "walker"])
every_pair = pytest.mark.parametrize("pair", sorted(PAIRS))


def checked(finding: Finding) -> None:
    assert finding.passed, str(finding)


def refused(finding: Finding) -> None:
    assert not finding.passed, str(finding)


# Exact scenes pass: the checks are not too strict.


@everyday_scenes
def test_exact_scenes_are_continuous(scene: str) -> None:
    checked(check_continuity(exact(scene), EXACT_RAYS, num_halvings=16, least_order=SHARP))


@pytest.mark.parametrize("scene", JUMPING)
def test_exact_scenes_that_jump_are_found_out(scene: str) -> None:
    refused(check_continuity(exact(scene), EXACT_RAYS, num_halvings=16, least_order=SHARP))


@everyday_scenes
def test_exact_scenes_do_not_pop(scene: str) -> None:
    checked(check_popping(exact(scene), RAYS, BOUNDARIES))


@everyday_scenes
def test_exact_scenes_close(scene: str) -> None:
    checked(check_closing(exact(scene), RAYS, exact(scene)))


@everyday_scenes
def test_exact_matter_keeps_its_colour(scene: str) -> None:
    # Where bodies of the walker overlap at joints colours are averaged, and what overlaps changes.
    checked(check_colour_along_tracks(exact(scene), RAYS, most=0.02))


@pytest.mark.parametrize("scene", CHANGING)
def test_exact_matter_that_changes_is_found_out(scene: str) -> None:
    refused(check_colour_along_tracks(exact(scene), RAYS, most=0.02))


@everyday_scenes
def test_exact_scenes_are_right_between_training_times(scene: str) -> None:
    checked(check_unseen_times(exact(scene), exact(scene), RAYS, TRAIN_TIMES))


def test_the_exact_static_scene_is_static() -> None:
    checked(check_static(exact("static"), RAYS, most=0.0))


# Pairs of a deformation and a canonical field pass, on every scene.


@every_pair
@everyday_scenes
def test_pairs_are_continuous(pair: str, scene: str) -> None:
    checked(check_continuity(fitted(pair, scene), RAYS, num_times=17, least_order=SMOOTH))


@every_pair
@everyday_scenes
def test_pairs_do_not_pop_at_slabs(pair: str, scene: str) -> None:
    checked(check_popping(with_occupancy(fitted(pair, scene)), RAYS, BOUNDARIES))


@every_pair
@everyday_scenes
def test_pairs_leave_canonical_space_alone(pair: str, scene: str) -> None:
    deformation = fitted(pair, scene).field.deformation
    checked(check_canonical_identity(deformation, deformation.canonical_time, torch.tensor(BOX)))


@every_pair
@everyday_scenes
def test_pairs_keep_colours_along_tracks(pair: str, scene: str) -> None:
    checked(check_colour_along_tracks(fitted(pair, scene), RAYS))


@every_pair
@everyday_scenes
def test_pairs_are_no_worse_between_training_times(pair: str, scene: str) -> None:
    checked(check_unseen_times(fitted(pair, scene), exact(scene), RAYS, TRAIN_TIMES))


@every_pair
@everyday_scenes
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
@everyday_scenes
def test_trained_pairs_pass_the_whole_suite(pair: str, scene: str) -> None:
    renderer = trained(pair, scene)
    steady = Renderer(renderer.field, StratifiedSampler(48, BOX))
    findings = [
        check_continuity(steady, RAYS, least_order=SMOOTH),
        # The sampler may hide matter thinner than its threshold: two levels on average.
        check_popping(renderer, RAYS, BOUNDARIES, most=2 * LEVEL),
        check_canonical_identity(renderer.field.deformation, 0.0, torch.tensor(BOX)),
        check_colour_along_tracks(renderer, RAYS),
        check_unseen_times(renderer, exact(scene), RAYS, TRAIN_TIMES),
    ]
    if scene == "static":
        # below the error of the pictures themselves, 0.07 after so little training
        findings.append(check_static(renderer, RAYS, most=0.05))
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


def test_time_in_eight_steps_is_not_continuous() -> None:
    model = retimed(fitted("displacement", "orbiting_balls"), eight_steps)
    refused(check_continuity(model, RAYS, least_order=SHARP))
    refused(check_popping(model, RAYS, BOUNDARIES))


def test_a_flickering_colour_is_not_continuous() -> None:
    model = tinted(fitted("displacement", "walker"), flicker)
    refused(check_continuity(model, RAYS, least_order=SHARP))
    refused(check_static(tinted(exact("static"), flicker), RAYS, most=0.02))


def test_a_fading_colour_is_continuous_but_not_the_same_along_tracks() -> None:
    model = DeformedField(
        fitted("displacement", "walker").field.deformation,
        Tinted(fitted("displacement", "walker").field.canonical, fade),
    )
    renderer = Renderer(model, StratifiedSampler(48, BOX))
    checked(check_continuity(renderer, RAYS, least_order=SMOOTH))
    refused(check_colour_along_tracks(renderer, RAYS))


def test_a_deformation_that_jumps_is_not_continuous() -> None:
    model = shifted(fitted("displacement", "walker"), jump)
    refused(check_continuity(model, RAYS, least_order=SHARP))
    checked(check_popping(model, RAYS, BOUNDARIES))  # it jumps elsewhere: only the search finds it
    refused(check_popping(model, RAYS, [0.53]))


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
