"""Small fast bodies that training finds in its pictures, and that the field then carries."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dnerf.backgrounds import RandomBackground
from dnerf.body_search import BodySearch, one_of_each_moment
from dnerf.data import SyntheticData
from dnerf.data.frames import Frames
from dnerf.data.synthetic import random_views, render_frames
from dnerf.deformations import CarriedBodies, DisplacementDeformation, FrameLattice, IdentityDeformation
from dnerf.deformations.carried_bodies import NOWHERE
from dnerf.error_map import ErrorMap
from dnerf.fast_bodies import FastBody, fast_bodies, joined_bodies
from dnerf.fields import Baking, DeformedField, GridField, SpaceTimeVolumes
from dnerf.motion import carry, motion_model
from dnerf.renderer import Renderer
from dnerf.run_state import CheckpointFolder
from dnerf.samplers import OccupancySampler
from dnerf.scenes import AnalyticScene, Ball, Body, Orbit, Plain
from dnerf.tracing import FrameTracer
from dnerf.training import Trainer
from dnerf.trajectories import Path as BodyPath
from dnerf.trajectories import PathSearch, Sighting

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
FAST = Orbit(0.9, 2.0, 0.1, 0.4)  # 0.14 units from frame to frame
SLOW = Orbit(0.3, 0.5, 0.0, -0.3)  # 0.012
RED, BLUE = (0.9, 0.2, 0.1), (0.1, 0.2, 0.9)
NUM_FRAMES = 80


def two_balls() -> AnalyticScene:
    bodies = [Body(Ball(0.12), Plain(RED), FAST, 200.0), Body(Ball(0.12), Plain(BLUE), SLOW, 200.0)]
    return AnalyticScene(bodies, box=BOX)


def frames_of_two_balls() -> Frames:
    return SyntheticData(two_balls(), 48, num_train=NUM_FRAMES).frames("train")


@pytest.fixture(scope="module")
def frames() -> Frames:
    return frames_of_two_balls()


def a_renderer(*, volumes: SpaceTimeVolumes | None = None, bodies: CarriedBodies | None = None) -> Renderer:
    torch.manual_seed(0)
    canonical = GridField(BOX, (4, 8), 2, hidden_features=16, space_time=volumes, density_shift=-3.0)
    field = DeformedField(
        IdentityDeformation(), canonical, bodies=CarriedBodies(4, NUM_FRAMES) if bodies is None else bodies
    )
    return Renderer(field, OccupancySampler(BOX, 0.1, 24, num_probes=512, pad_to=1), RandomBackground())


def wrong_where_matter_is(frames: Frames, *, is_known: bool = True) -> ErrorMap:
    """The map of a model that shows nothing."""
    error_map = ErrorMap(resolution=24)
    error_map.begin(frames)
    if is_known:
        alpha = frames.images[..., 3].float()[:, None] / 255
        error_map.errors.copy_(torch.nn.functional.max_pool2d(alpha, error_map.block)[:, 0] * 0.3)
    return error_map


def truth(motion: Orbit, times: Tensor) -> Tensor:
    return motion.relative(times).translation


def bodies_of(renderer: Renderer) -> CarriedBodies:
    assert isinstance(renderer.field, DeformedField)
    assert renderer.field.bodies is not None
    return renderer.field.bodies


@pytest.fixture(scope="module")
def searched(frames: Frames) -> Renderer:
    renderer = a_renderer()
    assert BodySearch(BOX)(300, renderer, frames, wrong_where_matter_is(frames))
    return renderer


def test_sightings_are_rays_through_the_balls(frames: Frames) -> None:
    seen = BodySearch(BOX).sightings(frames, wrong_where_matter_is(frames))
    misses = []
    for time, here in zip(frames.times, seen, strict=True):
        places = [truth(motion, time[None])[0].double().numpy() for motion in (FAST, SLOW)]
        for sighting in here:
            misses.append(min(sighting.miss(place) for place in places))
    misses = torch.tensor(misses)
    assert len(misses) > 1.6 * NUM_FRAMES  # they hide each other now and then
    assert float(misses.median()) < 0.015
    assert float((misses < 0.06).float().mean()) > 0.9


def test_the_fast_ball_is_carried_along_its_path_and_the_slow_one_is_not(frames: Frames, searched: Renderer) -> None:
    bodies = bodies_of(searched)
    assert bodies.num_bodies >= 1
    times = frames.times
    is_known = torch.zeros(len(times), dtype=torch.bool)
    for number in range(bodies.num_bodies):
        centers = bodies.centers(number, times).detach()
        is_there = centers.norm(dim=-1) < 3
        assert bool(is_there.any())
        misses = (centers - truth(FAST, times)).norm(dim=-1)[is_there]
        assert float(misses.median()) < 0.03
        is_known[is_there] |= misses < 0.08
    assert float(is_known.float().mean()) > 0.8


def test_of_cameras_that_see_one_moment_another_one_is_taken_each_time() -> None:
    assert one_of_each_moment(torch.tensor([0.5, 0.0, 1.0, 0.5, 0.0, 1.0, 0.25])) == [1, 6, 0, 5]
    assert one_of_each_moment(torch.tensor([1.0, 0.0, 0.5])) == [1, 2, 0]


def test_several_cameras_may_see_one_moment() -> None:
    poses, _ = random_views(2 * NUM_FRAMES)
    times = torch.linspace(0, 1, NUM_FRAMES).repeat(2)  # one camera's film after the other's
    frames = render_frames(two_balls(), poses, times, 48)
    renderer = a_renderer()
    assert BodySearch(BOX)(300, renderer, frames, wrong_where_matter_is(frames))
    bodies, times = bodies_of(renderer), times[:NUM_FRAMES]
    centers = bodies.centers(0, times).detach()
    is_there = centers.norm(dim=-1) < 3
    assert float(is_there.float().mean()) > 0.8
    assert float((centers - truth(FAST, times)).norm(dim=-1)[is_there].median()) < 0.03


def test_homes_are_off_all_tracks_and_the_sampler_looks_along_these(searched: Renderer) -> None:
    bodies, sampler = bodies_of(searched), searched.sampler
    assert isinstance(sampler, OccupancySampler)
    for number in range(bodies.num_bodies):
        others = bodies.tracks[: bodies.num_bodies].detach().reshape(-1, 3)
        assert float((others - bodies.homes[number]).norm(dim=-1).amin()) > 2 * float(bodies.radii[number])
        assert bool((bodies.homes[number].abs() < 1.5).all())
    times = torch.linspace(0.05, 0.95, 40)
    centers = bodies.centers(0, times).detach()
    is_there = centers.norm(dim=-1) < 3
    cells = ((centers[is_there] + 1.5) / 3 * 24).long()
    slabs = (times[is_there] * len(sampler.occupied)).long()
    assert bool(sampler.occupied[slabs, *cells.unbind(-1)].all())


def test_at_the_end_pictures_look_all_along_the_tracks(frames: Frames) -> None:
    """Even where no training sample was: between frames a fast body is elsewhere."""
    renderer = a_renderer()
    search = BodySearch(BOX)
    assert search(300, renderer, frames, wrong_where_matter_is(frames))
    bodies, sampler = bodies_of(renderer), renderer.sampler
    assert isinstance(sampler, OccupancySampler)
    renderer.field.density = lambda positions, times: torch.where(  # type: ignore[method-assign]
        (positions - bodies.centers(0, times)).norm(dim=-1) < 0.1, 50.0, 0.0
    )
    sampler.maxima.zero_()
    renderer.eval()
    search.finish(renderer)
    times = torch.linspace(0.02, 0.98, 400)
    centers = bodies.centers(0, times).detach()
    is_there = (centers.abs() < 1.5).all(-1)
    cells = ((centers[is_there] + 1.5) / 3 * 24).long()
    looked_into = sampler.looked_into(is_narrow=True)[0]
    slabs = (times[is_there] * len(looked_into)).long()
    assert float(looked_into[slabs, *cells.unbind(-1)].float().mean()) > 0.99
    assert float(looked_into.float().mean()) < 0.1


def test_thin_matter_is_planted_at_home_where_nothing_was(searched: Renderer, frames: Frames) -> None:
    """An empty place would stay empty: its density, and with it all gradients, is next to nothing."""
    bodies = bodies_of(searched)
    moves = 0.05 * torch.randn(200, 3).clamp(-1, 1)
    times = frames.times[torch.arange(200) % NUM_FRAMES]
    centers = bodies.centers(0, times).detach()
    is_there = centers.norm(dim=-1) < 3
    density = searched.field.density(centers + moves, times)[is_there].detach()
    empty = a_renderer().field.density(centers + moves, times)[is_there].detach()
    assert float(density.median()) > 10 * float(empty.median())
    assert all(parameter.grad is None for parameter in searched.parameters())


def test_parts_of_something_larger_and_what_hardly_fits_are_not_carried(frames: Frames) -> None:
    search, error_map = BodySearch(BOX), wrong_where_matter_is(frames)
    seen = search.sightings(frames, error_map)
    assert sum(sighting.is_alone for here in seen for sighting in here) > 1.3 * NUM_FRAMES
    path = max(
        (p for p in paths_in(seen, frames) if fast_bodies([p], search.min_speed)), key=lambda p: len(p.sightings)
    )
    attached = {number: replace(s, is_alone=False) for number, s in path.sightings.items()}
    [fast] = fast_bodies([BodyPath(attached)], search.min_speed)
    assert not fast.is_alone
    assert joined_bodies([fast], 1 / NUM_FRAMES) == []
    smaller = {number: replace(s, angle=0.01 * s.angle) for number, s in path.sightings.items()}
    assert fast_bodies([BodyPath(smaller)], search.min_speed) == []


def paths_in(seen: list[list[Sighting]], frames: Frames) -> list[BodyPath]:
    return PathSearch(list(map(list, BOX)), 0.1)(seen, frames.times.tolist())


def part(first: int, last: int, *, color: tuple[float, ...] = RED, radius: float = 0.2) -> FastBody:
    """Sightings of something at x = frame / 50, from three sides in turn, in frames first to last of 51."""
    sightings = {}
    for number in range(first, last + 1):
        away = np.roll([0.0, 0.0, 4.0], number)
        place = np.array([number / 50, 0.0, 0.0])
        direction = -away / 4
        sightings[number] = Sighting(number / 50, place + away, direction, radius / 4, np.array(color))
    return FastBody(BodyPath(sightings), radius, np.array(color))


def test_parts_of_one_way_are_joined_if_they_look_alike_and_are_never_there_at_once() -> None:
    whole = part(0, 20)
    assert whole.may_be(part(18, 40))
    assert not whole.may_be(part(10, 40))
    assert not whole.may_be(part(20, 40, color=BLUE))
    assert not whole.may_be(part(20, 40, radius=0.4))
    joined = whole.and_then(part(18, 40, radius=0.25))
    assert list(joined.path.sightings) == list(range(41))
    assert joined.path.sightings[19].angle == whole.path.sightings[19].angle
    assert joined.radius == 0.25
    assert not joined.may_be(part(30, 45))


def test_a_part_that_is_not_alone_is_joined_where_a_body_leads_to_it() -> None:
    whole = part(10, 30)
    for beside in (part(0, 8), part(32, 45), part(35, 45)):
        attached = replace(beside, is_alone=False)
        assert whole.leads_to(attached, 0.02)
        [joined] = joined_bodies([attached, whole], 0.02)
        assert len(joined.path.sightings) == 21 + len(beside.path.sightings)
        assert joined.is_alone
    late = replace(part(40, 50), is_alone=False)  # nothing is known of the frames in between
    assert not whole.leads_to(late, 0.02)
    aside = {n: replace(s, origin=s.origin + np.array([0.0, 0.5, 0.5])) for n, s in part(32, 45).path.sightings.items()}
    elsewhere = replace(part(32, 45), path=BodyPath(aside), is_alone=False)
    assert not whole.leads_to(elsewhere, 0.02)
    for other in (late, elsewhere):
        assert joined_bodies([other, whole], 0.02) == [whole]
    assert len(joined_bodies([part(40, 50), whole], 0.02)[0].path.sightings) == 32  # by looks, if both are alone


def test_a_track_fills_short_gaps_reaches_the_films_ends_and_is_nowhere_else() -> None:
    def known(body: FastBody) -> list[int]:
        track = body.track(51, 0.02)
        is_there = track[:, 0] < NOWHERE
        line = torch.linspace(0, 1, 51, dtype=torch.float64)
        torch.testing.assert_close(track[is_there, 0], line[is_there], rtol=0, atol=5e-3)
        return is_there.nonzero()[:, 0].tolist()

    assert known(part(3, 30)) == list(range(0, 32))
    assert known(part(10, 48)) == list(range(9, 51))
    assert known(part(10, 20).and_then(part(28, 40))) == list(range(9, 42))
    assert known(part(10, 20).and_then(part(35, 40))) == [*range(9, 22), *range(34, 42)]


def test_it_looks_once(frames: Frames, searched: Renderer) -> None:
    search = BodySearch(BOX, 0.4, min_steps=100)
    fresh = a_renderer()
    assert search.is_due(100, 0.4, fresh)
    assert not search.is_due(99, 0.4, fresh)
    assert not search.is_due(100, 0.39, fresh)
    assert not search.is_due(100, 0.95, fresh)
    assert not search.is_due(100, 0.4, searched)
    fresh.field.bodies = None  # type: ignore[assignment]
    assert not search.is_due(100, 0.4, fresh)


def test_nothing_is_carried_where_nothing_is_wrong_or_known_or_volumes_have_joined(frames: Frames) -> None:
    right = wrong_where_matter_is(frames)
    right.errors.mul_(1e-3)
    volumes = SpaceTimeVolumes(BOX, (4,), (4,), num_features=2)
    for renderer, error_map in (
        (a_renderer(), right),
        (a_renderer(), wrong_where_matter_is(frames, is_known=False)),
        (a_renderer(volumes=volumes), wrong_where_matter_is(frames)),
    ):
        assert not BodySearch(BOX)(300, renderer, frames, error_map)
        assert bodies_of(renderer).num_bodies == 0
        assert bodies_of(renderer).was_searched


@pytest.mark.parametrize("is_white", [True, False])
def test_what_pictures_show_about_where_it_is_is_not_carried(frames: Frames, is_white: bool) -> None:
    """Blocks of the map know a pixel or two. A body that is missing is carried, be it as white as what is behind it."""
    color = (1.0, 1.0, 1.0) if is_white else RED

    def ball(motion: Orbit) -> AnalyticScene:
        return AnalyticScene([Body(Ball(0.12), Plain(color), motion, 200.0)], box=BOX)

    scene = ball(FAST)
    late = ball(replace(FAST, phase=FAST.phase - 0.06 / (2 * math.pi * FAST.radius)))  # by half its radius
    pictures = SyntheticData(scene, 48, num_train=NUM_FRAMES).frames("train")
    found = []
    for canonical in (scene, late, GridField(BOX, (4, 8), 2, hidden_features=16, density_shift=-3.0)):
        field = DeformedField(IdentityDeformation(), canonical, bodies=CarriedBodies(4, NUM_FRAMES))
        renderer = Renderer(field, OccupancySampler(BOX, 0.03, 24, num_probes=512, pad_to=1), RandomBackground())
        renderer.train()
        found.append(BodySearch(BOX)(200, renderer, pictures, wrong_where_matter_is(pictures)))
        assert renderer.training
    assert found == [False, False, True]


def test_what_is_half_missing_is_carried_beside_what_is_missing(frames: Frames) -> None:
    """Of two fast bodies a deformation may have begun to follow one, by bending what lies around it."""
    other = replace(FAST, phase=FAST.phase + 0.4)

    def scene(density: float, other_density: float) -> AnalyticScene:
        balls = [
            Body(Ball(0.12), Plain(color), motion, each)
            for color, motion, each in ((RED, FAST, density), (BLUE, other, other_density))
            if each
        ]
        return AnalyticScene(balls, box=BOX)

    pictures = SyntheticData(scene(200.0, 200.0), 48, num_train=NUM_FRAMES).frames("train")
    found = []
    for shown in (scene(200.0, 7.0), scene(0.0, 7.0), scene(0.0, 200.0)):
        field = DeformedField(IdentityDeformation(), shown, bodies=CarriedBodies(4, NUM_FRAMES))
        renderer = Renderer(field, OccupancySampler(BOX, 0.03, 24, num_probes=512, pad_to=1), RandomBackground())
        BodySearch(BOX)(200, renderer, pictures, wrong_where_matter_is(pictures))
        found.append(bodies_of(renderer).num_bodies)
    assert found == [0, 2, 1]


def test_the_deformation_begins_anew_if_something_is_carried(frames: Frames, monkeypatch: pytest.MonkeyPatch) -> None:
    def deforms_after(error_map: ErrorMap) -> bool:
        renderer = a_renderer()
        assert isinstance(renderer.field, DeformedField)
        deformation = renderer.field.deformation = DisplacementDeformation(1, 8, (), canonical_time=None)
        torch.nn.init.constant_(deformation.mlp.output.bias, 0.01)
        BodySearch(BOX)(300, renderer, frames, error_map)
        points = torch.rand(5, 3)
        return not torch.equal(deformation(points, torch.rand(5)), points)

    wrong = wrong_where_matter_is(frames)
    assert not deforms_after(wrong)
    assert deforms_after(wrong_where_matter_is(frames, is_known=False))
    monkeypatch.setattr(BodySearch, "_home", lambda *_: None)  # no place is free
    assert deforms_after(wrong)


def test_opaque_pictures_tell_as_much(frames: Frames) -> None:
    picture = frames.images.float()
    on_white = (picture[..., :3] + 255 - picture[..., 3:]).round().to(torch.uint8)
    opaque = Frames(on_white, frames.poses, frames.times, frames.intrinsics, background="white")
    renderer = a_renderer()
    assert BodySearch(BOX)(300, renderer, opaque, wrong_where_matter_is(frames))


def test_room_is_limited_and_wrong_numbers_are_refused(frames: Frames) -> None:
    renderer = a_renderer(bodies=CarriedBodies(1, 50))
    assert BodySearch(BOX, min_speed=0.0)(300, renderer, frames, wrong_where_matter_is(frames))
    assert bodies_of(renderer).num_bodies == 1
    for settings in (
        {"begin": 0.9},
        {"begin": -0.1},
        {"error": 0.0},
        {"missing": 0.0},
        {"tolerance": -1.0},
        {"min_speed": -1.0},
    ):
        with pytest.raises(ValueError, match=next(iter(settings))):
            BodySearch(BOX, **settings)
    with pytest.raises(ValueError, match="box"):
        BodySearch(((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)))


def test_training_looks_and_a_run_that_goes_on_knows_it_has(frames: Frames, tmp_path: Path) -> None:
    def trainer(num_steps: int) -> Trainer:
        return Trainer(
            num_steps=num_steps, num_rays=64, progress_bar=False, error_map=ErrorMap(resolution=24),
            body_search=BodySearch(BOX, 0.0, min_steps=2), log_every=1,
        )  # fmt: skip

    renderer, folder = a_renderer(), CheckpointFolder(tmp_path)
    trainer(4).fit(renderer, frames, checkpoints=folder)
    assert bodies_of(renderer).was_searched
    again = a_renderer()
    trainer(5).fit(again, frames, checkpoints=folder, resume=True)
    assert bodies_of(again).was_searched
    with pytest.raises(ValueError, match="body_search must be of BodySearch or null, got 3"):
        Trainer(body_search=3)  # type: ignore[arg-type]


def carrying(canonical: GridField, *, moves: bool = True) -> tuple[DeformedField, CarriedBodies]:
    """A body on a line until time 0.5, gone then."""
    bodies = CarriedBodies(2, 11)
    track = torch.stack([torch.linspace(-0.8, 0.8, 11), torch.zeros(11), torch.zeros(11)], dim=-1)
    track[6:] = NOWHERE
    bodies.add(track, torch.tensor([0.9, 0.9, 0.9]), 0.3)
    deformation = DisplacementDeformation(2, 16, ()) if moves else IdentityDeformation()
    lattice = FrameLattice(BOX, 8)
    return DeformedField(deformation, canonical, bodies=bodies, frame_lattice=lattice, baking=Baking(BOX, 32)), bodies


def test_a_field_shows_at_the_track_what_is_at_home_and_nothing_at_the_home_of_what_is_gone() -> None:
    torch.manual_seed(0)
    canonical = GridField(BOX, (4, 8), 2, hidden_features=16)
    field, bodies = carrying(canonical, moves=False)
    moves = 0.1 * torch.randn(50, 3).clamp(-1, 1)
    early, late = torch.full((50,), 0.2), torch.full((50,), 0.9)
    home, center = bodies.homes[0] + moves, bodies.centers(0, early).detach() + moves
    directions = torch.zeros(50, 3)
    shown = field(center, directions, early)
    expected = canonical(home, directions, early)
    torch.testing.assert_close(shown.density, expected.density)
    torch.testing.assert_close(shown.rgb, expected.rgb)
    torch.testing.assert_close(field.density(center, early), expected.density)
    torch.testing.assert_close(shown.extras["carried_positions"], home)
    torch.testing.assert_close(field.density(home, early), canonical.density(center, early))
    assert not bool(field.density(home, late).any())
    assert not bool(field(home, directions, late).density.any())
    torch.testing.assert_close(field.density(center, late), canonical.density(center, late))


def test_frames_and_motion_know_what_is_carried() -> None:
    """The lattice holds the deformation behind the bodies; no ray goes through it before them."""
    torch.manual_seed(0)
    canonical = GridField(BOX, (4, 8), 2, hidden_features=16)
    canonical.table.data.mul_(1000)  # so that places differ
    field, bodies = carrying(canonical, moves=False)
    field.eval()
    times = torch.full((400,), 0.2)
    positions = bodies.centers(0, times).detach() + 0.1 * torch.randn(400, 3).clamp(-1, 1)
    apart = (field.density(positions, times) - canonical.density(positions, times)).abs().mean()
    assert float(apart.detach()) > 0.03  # beyond the tolerance below
    field.deformation = DisplacementDeformation(2, 16, ())  # at rest, as it begins, but not an identity by type
    frozen = field.at_time(0.2)
    torch.testing.assert_close(frozen.density(positions, times), field.density(positions, times), rtol=1e-2, atol=1e-2)
    baked = field.finished()
    assert isinstance(baked, DeformedField)
    assert baked.bodies is bodies
    sampler = OccupancySampler(BOX, 0.1, 24, num_probes=512, pad_to=1)
    grid = sampler.grid_at(0.2, torch.float32)
    assert FrameTracer.of(baked.at_time(0.2), grid, 0.2, 1e-3) is not None
    moved, residual = carry(motion_model(field), bodies.centers(0, torch.zeros(1)).detach(), 0.0, 0.4)
    torch.testing.assert_close(moved, bodies.centers(0, torch.tensor([0.4])).detach(), rtol=0, atol=2e-3)
    assert float(residual) < 1e-3
