"""Paths of bodies from rays of single pictures."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dnerf.trajectories import Array, Path, PathSearch, Sighting, triangulated, without_stragglers

BOX = [[-1.5] * 3, [1.5] * 3]
TIMES = np.linspace(0, 1, 100)
RED, BLUE = np.array([0.9, 0.1, 0.1]), np.array([0.1, 0.2, 0.9])


def sighting(
    time: float, position: Array, generator: np.random.Generator, *, color: Array = RED, noise: float = 0.0
) -> Sighting:
    """What a random camera four units away sees of a ball of radius 0.06."""
    away = generator.normal(size=3)
    origin = 4 * away / np.linalg.norm(away)
    seen = position + noise * generator.normal(size=3) - origin
    distance = float(np.linalg.norm(seen))
    return Sighting(time, origin, seen / distance, 0.06 / distance, color)


def circle(times: Array, turns: float = 2.0, radius: float = 0.96) -> Array:
    angle = 2 * np.pi * turns * times
    return radius * np.stack([np.cos(angle), np.sin(angle) * 0.92, np.sin(angle) * 0.39], axis=-1)


@given(seed=st.integers(0, 10_000))
def test_three_rays_of_three_times_determine_a_straight_path(seed: int) -> None:
    """Closed form, wherever the cameras are."""
    generator = np.random.default_rng(seed)
    truth = generator.normal(size=(2, 3)) * [[0.5], [0.05]]
    sightings = [sighting(t, truth[0] + truth[1] * t / 0.02, generator) for t in (0.0, 0.02, 0.06)]
    found = triangulated(sightings, 1, 0.0, 0.02)
    assert max(s.miss(found[0] + found[1] * s.time / 0.02) for s in sightings) < 1e-4


def test_a_curved_path_is_found_to_the_weight_that_holds_curves_back() -> None:
    generator = np.random.default_rng(0)
    truth = np.array([[0.3, -0.2, 0.1], [0.08, 0.05, -0.04], [0.01, -0.01, 0.005]])
    times = 0.02 * np.arange(8)
    sightings = [sighting(t, (t / 0.02) ** np.arange(3) @ truth, generator) for t in times]
    np.testing.assert_allclose(triangulated(sightings, 2, 0.0, 0.02), truth, atol=2e-3)


@pytest.mark.parametrize("seed", range(6))
def test_a_wrong_sighting_does_not_bend_a_curve_with_a_scale(seed: int) -> None:
    """One of eight is of a body that melts with a larger one in its picture: its middle is beside the body's."""
    generator = np.random.default_rng(seed)
    truth = circle(TIMES, turns=1.0)
    seen = [sighting(TIMES[i], truth[i], generator, noise=0.002) for i in range(20, 28)]
    seen[4] = sighting(TIMES[24], truth[24] + 0.09 * generator.choice([-1, 1], 3), generator)
    plain, robust = (
        float(np.linalg.norm(triangulated(seen, 2, TIMES[29], 0.01, scale=scale)[0] - truth[29]))
        for scale in (None, 0.01)
    )
    assert robust < 0.04
    assert robust < plain


@pytest.mark.parametrize("seed", range(5))  # with 5 there are five frames in a row without a sighting
def test_a_body_is_followed_that_some_pictures_do_not_show_and_some_show_beside_its_place(seed: int) -> None:
    """As a bead that circles a large ball: before that it is not told apart, at its edge it melts with it."""
    generator = np.random.default_rng(seed)
    truth = circle(TIMES, turns=1.0)
    frames: list[list[Sighting]] = []
    for i, time in enumerate(TIMES):
        kind = generator.uniform()
        if kind < 0.35:
            frames.append([])
        elif kind < 0.5:
            seen = sighting(time, truth[i] + 0.05 * generator.choice([-1, 1], 3), generator)
            frames.append([replace(seen, angle=1.35 * seen.angle, is_alone=False)])
        else:
            frames.append([sighting(time, truth[i], generator, noise=0.002)])
    found = PathSearch(BOX, 0.1)(frames, TIMES.tolist())
    assert len(found) == 1
    shown = [number for number, seen in enumerate(frames) if seen]
    assert min(found[0].sightings) <= shown[2]
    assert max(found[0].sightings) >= shown[-3]
    assert np.median(misses_of(TIMES, truth, found[0], scale=0.03)[shown[2] : shown[-3]]) < 0.02


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_bodies_are_followed_among_things_that_are_none(seed: int) -> None:
    """A seventh of the sightings missing, four false ones a frame, half of them parts of others; own rays 0.005 off."""
    generator = np.random.default_rng(seed)
    paths = {"red": circle(TIMES), "blue": -0.6 * circle(TIMES, turns=1.0)[:, [2, 0, 1]]}
    frames: list[list[Sighting]] = []
    for i, time in enumerate(TIMES):
        seen = [
            replace(
                sighting(time, generator.uniform(-1, 1, 3), generator, color=generator.uniform(size=3)), is_alone=n < 2
            )
            for n in range(4)
        ]
        for name, color in (("red", RED), ("blue", BLUE)):
            if generator.uniform() < 0.85:
                seen.append(sighting(time, paths[name][i], generator, color=color, noise=0.005))
        frames.append(seen)
    found = PathSearch(BOX, 0.1)(frames, TIMES.tolist())
    for name, color in (("red", RED), ("blue", BLUE)):
        own = [path for path in found if all(s.is_alike(color) for s in path.sightings.values())]
        numbers = sorted(number for path in own for number in path.sightings)
        assert len(numbers) == len(set(numbers))
        assert len(numbers) > 0.6 * len(TIMES)
        for path in own:
            own_times = np.array(list(path.sightings))
            misses = np.linalg.norm(path.positions(TIMES)[own_times] - paths[name][own_times], axis=-1)
            assert np.median(misses) < 0.012
            assert (misses < 0.06).mean() > 0.85  # a path may end with something that is none


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_nothing_is_found_among_things_that_are_none(seed: int) -> None:
    generator = np.random.default_rng(seed)
    frames = [[sighting(t, generator.uniform(-1, 1, 3), generator) for _ in range(3)] for t in TIMES]
    assert PathSearch(BOX, 0.1)(frames, TIMES.tolist()) == []


def test_few_frames_or_none_and_frames_of_one_time() -> None:
    search = PathSearch(BOX, 0.1)
    assert search([], []) == []
    generator = np.random.default_rng(0)
    seen = [[sighting(0.5, np.zeros(3), generator)] for _ in range(20)]
    assert search(seen[:1], [0.5]) == []
    assert search(seen, [0.5] * 20) == []


def test_a_path_ends_where_it_is_not_seen_for_long() -> None:
    generator = np.random.default_rng(0)
    truth = circle(TIMES)
    frames = [[sighting(t, x, generator)] for t, x in zip(TIMES, truth)]
    frames[45:55] = [[] for _ in range(10)]
    found = PathSearch(BOX, 0.1)(frames, TIMES.tolist())
    assert sorted((min(path.sightings), max(path.sightings)) for path in found) == [(0, 44), (55, 99)]


def test_positions_go_straight_on_outside_of_what_is_seen() -> None:
    generator = np.random.default_rng(0)
    line = np.outer(TIMES, [0.5, -0.3, 0.2])
    path = Path({i: sighting(TIMES[i], line[i], generator) for i in range(10, 90)})
    np.testing.assert_allclose(path.positions(TIMES), line, atol=5e-3)


def misses_of(times: Array, truth: Array, path: Path, **settings: float) -> Array:
    return np.linalg.norm(path.positions(times, **settings) - truth, axis=-1)


@pytest.mark.parametrize("seed", range(4))
def test_single_wrong_sightings_do_not_bend_a_path_with_a_scale(seed: int) -> None:
    generator = np.random.default_rng(seed)
    truth = circle(TIMES)
    seen = {i: sighting(t, truth[i], generator, noise=0.005) for i, t in enumerate(TIMES) if generator.uniform() < 0.7}
    for number in (20, 55, 80):
        seen[number] = sighting(TIMES[number], truth[number] + [0.2, -0.2, 0.2], generator)
    path = Path(dict(sorted(seen.items())))
    plain, robust = misses_of(TIMES, truth, path), misses_of(TIMES, truth, path, scale=0.03)
    assert plain[[20, 55, 80]].max() > 0.04
    assert robust[[20, 55, 80]].max() < 0.02
    assert robust[8:92].max() < 0.03
    assert robust.mean() < 0.7 * plain.mean()


@pytest.mark.parametrize("seed", range(4))
def test_a_path_does_not_end_at_what_is_not_alone_with_a_scale(seed: int) -> None:
    """Its first two sightings are beside its place: a path that trusts them goes on from there."""
    generator = np.random.default_rng(seed)
    truth = circle(TIMES, turns=1.0)
    seen = {i: sighting(TIMES[i], truth[i], generator, noise=0.002) for i in range(3, 60)}
    for number in (3, 4):
        beside = sighting(TIMES[number], truth[number] + 0.06 * generator.choice([-1, 1], 3), generator)
        seen[number] = replace(beside, is_alone=False)
    trusted = Path({number: replace(each, is_alone=True) for number, each in seen.items()})
    first = misses_of(TIMES, truth, Path(seen), scale=0.03)[:4].max()
    assert first < 0.15
    assert first < misses_of(TIMES, truth, trusted, scale=0.03)[:4].max()


@pytest.mark.parametrize("seed", range(4))
def test_with_a_scale_paths_are_stiff_but_bounce(seed: int) -> None:
    """Off the sharp turn no further than a ball of 0.06 would show, and elsewhere as near as rays allow."""
    generator = np.random.default_rng(seed)
    height = np.abs(1 - 4 * np.abs(TIMES - 0.5)) - 0.5
    truth = np.stack([2 * TIMES - 1, 0.5 * TIMES, height], axis=-1)
    seen = {i: sighting(t, truth[i], generator, noise=0.003) for i, t in enumerate(TIMES)}
    robust = misses_of(TIMES, truth, Path(seen), scale=0.03)
    assert robust.max() < 0.06
    assert np.median(robust) < 0.005
    turned = misses_of(TIMES, truth, Path(seen))
    assert np.median(robust) < np.median(turned)


def test_what_is_not_alone_is_no_end_of_a_path_behind_frames_in_vain() -> None:
    generator = np.random.default_rng(0)
    truth = circle(TIMES)
    seen = {i: sighting(TIMES[i], truth[i], generator) for i in (3, *range(20, 50), 53, 55)}
    assert list(without_stragglers(seen)) == list(seen)  # they are alone
    beside = {number: replace(each, is_alone=number in range(20, 50)) for number, each in seen.items()}
    assert list(without_stragglers(beside)) == [*range(20, 50), 53, 55]  # each of the last two confirms the other
    del beside[55]
    assert list(without_stragglers(beside)) == [*range(20, 50)]
    lone = {3: beside[3]}
    assert without_stragglers(lone) == lone


def test_behind_a_camera_nothing_has_a_size() -> None:
    seen = Sighting(0.0, np.zeros(3), np.array([0.0, 0.0, -1.0]), 0.1, RED)
    assert seen.radius_at(np.array([0.0, 0.0, 1.0])) < 0 < seen.radius_at(np.array([0.0, 0.0, -1.0]))
    assert seen.miss(np.array([0.3, 0.4, -7.0])) == pytest.approx(0.5)
