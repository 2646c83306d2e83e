"""Paths of small bodies from where single pictures, each of another time and camera, show them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ALIKE = 0.25  # most that colours of one body's sightings differ
SIZES = 2.5  # most by which their radii do, as a factor
WINDOW = 10  # sightings of which a path's next place is foretold
GAP = 4  # frames in a row without a sighting after which a path ends
MOST_SKIPPED = 1  # of them, behind which something that is not alone may be a path's last sighting
AROUND = (-2, -1, 1, 2)  # frames beside three in a row that have to agree with them, two at least
MOST_BEGINNING = 4  # sightings of a frame, the first ones that are alone, with which paths begin
MOST_TRIED = 400  # beginnings of paths
STIFFNESS, STIFF = 0.1, 10.0  # weights of third differences: at first, and where a path does not turn
TURN = 0.3  # of the scale of distances, from which third differences are a turn
ROUNDS = 8  # of reweighting
SURE = 0.1  # of the tolerance: a sighting that a curve passes further away hardly counts
MELTED = 0.1  # weight of a sighting that is not alone: its middle may be that of more than the body
CURVED = 5  # sightings from which on a path is taken for curved


@dataclass(frozen=True, eq=False)
class Sighting:
    """Something small in one picture.

    Args:
        time: of the picture.
        origin: (3,) of the ray through its middle, in world units.
        direction: (3,), unit.
        angle: half of its width as the camera sees it, in radians.
        color: (3,).
        is_alone: whether nothing else is beside it in the picture.
        pixels: (P,) int64, some of its pixels, see `Frames.pixels`; none if nobody asks for them.
    """

    time: float
    origin: Array
    direction: Array
    angle: float
    color: Array
    is_alone: bool = True
    pixels: Array = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def across(self) -> Array:
        """(3, 3), which leaves of a vector what is at right angles to the ray."""
        return np.eye(3) - np.outer(self.direction, self.direction)

    def miss(self, position: Array) -> float:
        """Distance of a position (3,) from the ray."""
        return float(np.linalg.norm(self.across @ (position - self.origin)))

    def radius_at(self, position: Array) -> float:
        """Of what is that wide at the position's distance; not positive behind the camera."""
        return float((position - self.origin) @ self.direction) * self.angle

    def is_alike(self, color: Array) -> bool:
        """Whether it has about that colour."""
        return bool(np.abs(self.color - color).max() <= ALIKE)


@dataclass(frozen=True, eq=False)
class _Known:
    """The sightings of a frame: rays and colours, (N, 3) each."""

    origins: Array
    directions: Array
    colors: Array

    @classmethod
    def of(cls, seen: Sequence[Sighting]) -> "_Known":
        columns = ([getattr(s, name) for s in seen] for name in ("origin", "direction", "color"))
        return cls(*(np.array(column, dtype=np.float64).reshape(-1, 3) for column in columns))

    def miss(self, position: Array, color: Array) -> float:
        """Distance of a position (3,) from the nearest ray of about that colour (3,)."""
        away = position - self.origins
        along = (away * self.directions).sum(-1, keepdims=True)
        misses = np.linalg.norm(away - along * self.directions, axis=-1)
        is_alike = (np.abs(self.colors - color) <= ALIKE).all(-1)
        return float(misses[is_alike].min(initial=np.inf))


@dataclass(frozen=True)
class Path:
    """Sightings of one body, one per frame at most.

    Args:
        sightings: by the frame's number in order of time.
    """

    sightings: dict[int, Sighting]

    def positions(self, times: Array, *, scale: float | None = None) -> Array:
        """Where the body is at evenly spaced times (T,): the smooth path that passes its rays most closely, (T, 3).

        Least squares of distances from rays and of third differences; before and after all sightings it goes on as it
        went last. With a scale both are reweighted some rounds: a ray that is passed far away and a turn between two
        times then hardly count, so that single wrong sightings do not bend the path, and it is as stiff as bodies that
        nothing hits. Nor do sightings count much then that are not alone.

        Source: iteratively reweighted least squares (Holland and Welsch 1977) with Cauchy's weights.

        Args:
            times: T >= 4, increasing evenly.
            scale: distance from a ray, in world units, from which that hardly counts; None takes all as they are.
        """
        count, step = len(times), times[1] - times[0]
        sightings = list(self.sightings.values())
        seen = np.array([sighting.time for sighting in sightings])
        places = np.clip((seen - times[0]) / step, 0, count - 1)
        before, numbers = np.minimum(places.astype(int), count - 2), np.arange(len(places))
        shares = np.zeros((len(places), count))
        shares[numbers, before], shares[numbers, before + 1] = before + 1 - places, places - before
        across = np.stack([sighting.across for sighting in sightings])
        origins = np.stack([sighting.origin for sighting in sightings])
        third, second = (np.diff(np.eye(count), n=n, axis=0) for n in (3, 2))
        slack = 1e-3 * STIFFNESS * second.T @ second + 1e-9 * np.eye(count)
        own = _trust(sightings, scale)
        weights, stiffness, rounds = own, np.full(count - 3, STIFFNESS), 0
        while True:
            weighted = (shares * weights[:, None]).T
            matrix = np.einsum("in,nj,nab->iajb", weighted, shares, across, optimize=True)
            right = np.einsum("in,nab,nb->ia", weighted, across, origins, optimize=True)
            prior = np.kron(third.T @ (stiffness[:, None] * third) + slack, np.eye(3))
            found = np.linalg.solve(matrix.reshape(3 * count, 3 * count) + prior, right.reshape(-1)).reshape(count, 3)
            if scale is None or rounds == ROUNDS:
                return np.asarray(found, dtype=np.float64)
            misses = np.linalg.norm(np.einsum("nab,nb->na", across, shares @ found - origins), axis=-1)
            weights = own / (1 + (misses / scale) ** 2)
            stiffness = STIFF / (1 + (np.linalg.norm(third @ found, axis=-1) / (TURN * scale)) ** 2)
            rounds += 1


def _trust(sightings: Sequence[Sighting], scale: float | None) -> Array:
    """How much sightings (N,) count by themselves: less if they are not alone, unless all are taken as they are."""
    return np.array([1.0 if scale is None or sighting.is_alone else MELTED for sighting in sightings])


def without_stragglers(sightings: dict[int, Sighting]) -> dict[int, Sighting]:
    """The same in order, without what was found at either end behind frames in vain, if it is not even alone."""
    kept = dict(sorted(sightings.items()))
    for is_last in (False, True):
        while len(kept) > 1:
            end, beside = sorted(kept, reverse=is_last)[:2]
            if kept[end].is_alone or abs(beside - end) <= MOST_SKIPPED + 1:
                break
            del kept[end]
    return kept


def triangulated(
    sightings: Sequence[Sighting], degree: int, time: float, unit: float, *, scale: float | None = None
) -> Array:
    """The polynomial in time that passes their rays most closely.

    Source: trajectory triangulation (Avidan and Shashua 2000): three rays of three times determine a straight path
    of constant speed, if the cameras differ.

    Args:
        sightings: at least degree + 1.
        degree: of the polynomial.
        time: from which its argument counts.
        unit: of its argument, in time.
        scale: distance from a ray, in world units, from which that hardly counts, see `Path.positions`, and neither
            do sightings that are not alone; None takes all as they are.

    Returns:
        Coefficients (degree + 1, 3): the first is where it is at `time`.
    """
    count = degree + 1
    powers = ((np.array([s.time for s in sightings]) - time) / unit)[:, None] ** np.arange(count)
    across = np.stack([s.across for s in sightings])
    origins = np.stack([s.origin for s in sightings])
    prior = np.kron(np.diag([1e-9, 1e-9, *([1e-3] * (count - 2))]), np.eye(3))  # curves are weakly held back
    own = _trust(sightings, scale)
    weights, rounds = own, 0
    while True:
        weighted = powers * weights[:, None]
        matrix = np.einsum("nk,nl,nij->kilj", weighted, powers, across).reshape(3 * count, 3 * count)
        right = np.einsum("nk,nij,nj->ki", weighted, across, origins).reshape(-1)
        found = np.linalg.solve(matrix + prior, right).reshape(count, 3)
        if scale is None or rounds == ROUNDS:
            return np.asarray(found, dtype=np.float64)
        misses = np.linalg.norm(np.einsum("nij,nj->ni", across, powers @ found - origins), axis=-1)
        weights = own / (1 + (misses / scale) ** 2)
        rounds += 1


class PathSearch:
    """Finds which sightings, one per frame at most, are of one body.

    Three sightings of three frames next to each other, each alone in its picture, determine a straight path; where two
    of the frames around agree, it is followed to both sides, foretold by a curve through its latest sightings, as long
    as they come.

    Args:
        box: (2, 3) corners of where bodies may be.
        tolerance: most distance of a foretold place from a ray, in world units.
        min_sightings: of a path.
        min_share: of the frames between its first and its last sighting in which it is seen.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], tolerance: float, *, min_sightings: int = 8, min_share: float = 0.5
    ) -> None:
        self.low, self.high = (np.asarray(corner, dtype=float) for corner in box)
        self.tolerance = tolerance
        self.min_sightings = min_sightings
        self.min_share = min_share

    def __call__(self, frames: Sequence[Sequence[Sighting]], times: Sequence[float]) -> list[Path]:
        """Paths, none of which shares a sighting with another.

        Args:
            frames: F times what is seen in a frame, in order of time.
            times: (F,), increasing.
        """
        unit = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
        if unit <= 0:
            return []
        used: set[int] = set()
        paths = []
        for beginning in self._beginnings(frames, times, unit)[:MOST_TRIED]:
            if any(id(sighting) in used for sighting in beginning.values()):
                continue
            found = self._followed(beginning, frames, times, unit, used)
            length = max(found) - min(found) + 1
            if len(found) >= max(self.min_sightings, self.min_share * length):
                used.update(id(sighting) for sighting in found.values())
                paths.append(Path(dict(sorted(found.items()))))
        return paths

    def _beginnings(
        self, frames: Sequence[Sequence[Sighting]], times: Sequence[float], unit: float
    ) -> list[dict[int, Sighting]]:
        """Threes of sightings on straight paths, those first with which most others agree, and most closely."""
        alone = [[s for s in seen if s.is_alone][:MOST_BEGINNING] for seen in frames]
        numbers, threes = [], []
        for first in range(len(frames) - 2):
            for gaps in ((1, 2), (1, 3), (2, 3)):
                chosen = (first, first + gaps[0], first + gaps[1])
                if chosen[2] < len(frames):
                    some = list(product(*(alone[number] for number in chosen)))
                    threes += some
                    numbers += [chosen] * len(some)
        if not threes:
            return []
        moments = np.array(times)[np.array(numbers)]
        lines, is_body = self._lines(threes, moments, unit)
        known = [_Known.of(seen) for seen in frames]
        found: list[tuple[int, float, dict[int, Sighting]]] = []
        for index in np.flatnonzero(is_body):
            first, third = numbers[index][0], numbers[index][2]
            near = []
            for number in (first + n if n < 0 else third + n for n in AROUND):
                if 0 <= number < len(frames):
                    place = lines[index, 0] + lines[index, 1] * (times[number] - times[first]) / unit
                    near.append(known[number].miss(place, threes[index][1].color))
            near = [miss for miss in near if miss < 2 * self.tolerance]
            if len(near) >= 2:
                found.append((-len(near), sum(near), dict(zip(numbers[index], threes[index]))))
        return [three for _, _, three in sorted(found, key=lambda each: each[:2])]

    def _lines(self, threes: Sequence[Sequence[Sighting]], moments: Array, unit: float) -> tuple[Array, Array]:
        """Straight paths (N, 2, 3) through threes of moments (N, 3), see `triangulated`; whose are of a body, (N,)."""
        origins, directions, colors = (
            np.array([[getattr(s, name) for s in three] for three in threes])
            for name in ("origin", "direction", "color")
        )
        angles = np.array([[s.angle for s in three] for three in threes])
        across = np.eye(3) - directions[..., None] * directions[..., None, :]
        powers = ((moments - moments[:, :1]) / unit)[..., None] ** np.arange(2)
        matrix = np.einsum("nsk,nsl,nsij->nkilj", powers, powers, across).reshape(-1, 6, 6) + 1e-9 * np.eye(6)
        right = np.einsum("nsk,nsij,nsj->nki", powers, across, origins).reshape(-1, 6, 1)
        lines = np.linalg.solve(matrix, right).reshape(-1, 2, 3)
        places = np.einsum("nsk,nki->nsi", powers, lines)
        radii = ((places - origins) * directions).sum(-1) * angles
        is_alike = (np.abs(colors[:, 1:] - colors[:, :1]) <= ALIKE).all((-1, -2))
        is_inside = ((places > self.low) & (places < self.high)).all((-1, -2))
        is_one_size = (radii.min(-1) > 0) & (radii.max(-1) < SIZES * radii.min(-1))
        return lines, is_alike & is_inside & is_one_size

    def _is_inside(self, position: Array) -> bool:
        return bool((position > self.low).all() and (position < self.high).all())

    def _followed(
        self,
        beginning: dict[int, Sighting],
        frames: Sequence[Sequence[Sighting]],
        times: Sequence[float],
        unit: float,
        used: set[int],
    ) -> dict[int, Sighting]:
        found = dict(beginning)
        for direction, number in ((1, max(found)), (-1, min(found))):
            missed = 0
            while missed <= GAP and 0 <= number + direction < len(frames):
                number += direction
                latest = sorted(found, key=lambda m: abs(m - number))[:WINDOW]
                known = [found[m] for m in latest]
                sighting = self._next(
                    known, [s for s in frames[number] if id(s) not in used], times[number], unit, missed
                )
                if sighting is None:
                    missed += 1
                else:
                    found[number], missed = sighting, 0
        return without_stragglers(found)

    def _next(
        self, known: Sequence[Sighting], candidates: Sequence[Sighting], time: float, unit: float, missed: int
    ) -> Sighting | None:
        """Which of the candidates at that time goes on from what is known, if any does."""
        is_curved = len(known) >= CURVED
        degree, scale = (2, SURE * self.tolerance) if is_curved else (1, None)
        curve = triangulated(known, degree, time, unit, scale=scale)
        if not self._is_inside(curve[0]):
            return None
        color = np.median([s.color for s in known], axis=0)
        places = [((s.time - time) / unit) ** np.arange(len(curve)) @ curve for s in known]
        radius = float(np.median([s.radius_at(place) for s, place in zip(known, places)]))
        tolerance = self.tolerance * (1 + 0.5 * missed) * (1 if is_curved else 2)
        near = [
            s
            for s in candidates
            if s.is_alike(color)
            and s.miss(curve[0]) < tolerance
            and radius / SIZES < s.radius_at(curve[0]) < radius * SIZES
        ]
        return min(near, key=lambda s: s.miss(curve[0]), default=None)
