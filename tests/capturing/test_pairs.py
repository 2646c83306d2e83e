"""Which frames are compared with which."""

from itertools import combinations, pairwise

import pytest

from dnerf.capturing.pairs import FEW, image_pairs


def film(count: int, name: str = "") -> list[str]:
    return [f"{name}{index:05d}" for index in range(count)]


@pytest.mark.parametrize("matching", ["auto", "sequential", "exhaustive"])
@pytest.mark.parametrize("count", [3, FEW, 3 * FEW])
def test_neighbours_are_compared_and_no_pair_twice(count: int, matching: str) -> None:
    pairs = image_pairs([film(count)], matching)
    unordered = {frozenset(pair) for pair in pairs}
    assert len(unordered) == len(pairs)
    assert all(len(pair) == 2 for pair in unordered)
    assert {frozenset(pair) for pair in pairwise(film(count))} <= unordered


def test_few_frames_are_all_compared() -> None:
    assert image_pairs([film(FEW)]) == list(combinations(film(FEW), 2))
    assert image_pairs([film(400)], "exhaustive") == list(combinations(film(400), 2))


def test_a_long_film_is_compared_in_a_number_of_pairs_that_grows_with_its_length() -> None:
    few, many = (len(image_pairs([film(count)])) for count in (1000, 2000))
    assert many < 2.2 * few
    assert few < 15 * 1000


def test_a_long_film_may_come_back_to_any_place() -> None:
    pairs = {frozenset(pair) for pair in image_pairs([film(500)])}
    assert frozenset((film(500)[0], film(500)[480])) in pairs


def test_films_are_compared_at_the_same_moment() -> None:
    left, right = film(100, "left/"), film(100, "right/")
    assert set(zip(left, right)) <= set(image_pairs([left, right]))
