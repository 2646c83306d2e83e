"""Which frames are compared with which: neighbours of a film, and enough others to close its loops."""

from collections.abc import Iterator, Sequence
from itertools import combinations

NEIGHBOURS = (*range(1, 9), 12, 18, 27)  # how many frames on
NUM_ANCHORS = 25  # frames of each film that are compared with those of all films: it may come back to a place
FEW = 60  # up to so many frames all are compared


def image_pairs(films: Sequence[Sequence[str]], matching: str = "auto") -> list[tuple[str, str]]:
    """Pairs of names, each once.

    Args:
        films: names of each film's frames, in order.
        matching: "exhaustive" compares all, "sequential" neighbours of a film and some others; "auto" all if they are
            few.
    """
    names = [name for film in films for name in film]
    if matching == "exhaustive" or (matching == "auto" and len(names) <= FEW):
        return list(combinations(names, 2))
    return sorted({(min(pair), max(pair)) for pair in _sequential(films) if pair[0] != pair[1]})


def _sequential(films: Sequence[Sequence[str]]) -> Iterator[tuple[str, str]]:
    anchors: list[str] = []
    for film in films:
        for index, name in enumerate(film):
            yield from ((name, film[index + step]) for step in NEIGHBOURS if index + step < len(film))
        stride = max(1, len(film) // NUM_ANCHORS)
        anchors += film[::stride]
    yield from combinations(anchors, 2)
    # Films that began together show the same moment in frames of the same number.
    for first, second in combinations(films, 2):
        yield from zip(first, second)
