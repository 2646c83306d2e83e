"""Which paths are of small bodies that are too fast for a deformation, and which of one body."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from dnerf.deformations.carried_bodies import NOWHERE
from dnerf.trajectories import ALIKE, GAP, WINDOW, Array, Path, triangulated

ALONE = 0.5  # least of a body's sightings that are
MOST_MISSED = 0.5  # of its radius, by which half of its rays may pass its path
SIMILAR = 1.5  # most by which radii of one body's parts differ, as a factor
OVERLAP = 4  # sightings of one part of its way within another: at their ends
MOST_APART = 2 * GAP  # frames between parts of which one is not alone: a body that passes others on its way
FINE = 101  # times at which a path is looked at


@dataclass(frozen=True, eq=False)
class FastBody:
    """A body that is to be carried.

    Args:
        path: of its sightings.
        radius: in world units.
        color: (3,).
        is_alone: whether it is mostly seen by itself; if not, it may be a part of something larger.
    """

    path: Path
    radius: float
    color: Array
    is_alone: bool = True

    def may_be(self, other: "FastBody") -> bool:
        """Whether both may be parts of one body's way: they look alike and are hardly ever there at once."""
        is_alike = bool(np.abs(self.color - other.color).max() <= ALIKE)
        sizes = sorted((self.radius, other.radius))
        frames, others = sorted(self.path.sightings), sorted(other.path.sightings)
        within = sum(frames[0] <= number <= frames[-1] for number in others)
        return is_alike and sizes[1] < SIMILAR * sizes[0] and within <= OVERLAP

    def leads_to(self, other: "FastBody", spacing: float) -> bool:
        """Whether its way goes on to where the other's begins, or came from where that one's ends.

        Args:
            other: of another part of the film.
            spacing: of frames, in time.
        """
        frames, others = sorted(self.path.sightings), sorted(other.path.sightings)
        end, begin = (frames[-1], others[0]) if frames[0] < others[0] else (frames[0], others[-1])
        known = [self.path.sightings[n] for n in sorted(frames, key=lambda n: abs(n - begin))[:WINDOW]]
        sighting = other.path.sightings[begin]
        place = triangulated(known, 2, sighting.time, spacing)[0]
        return abs(begin - end) <= MOST_APART and sighting.miss(place) <= self.radius

    def and_then(self, other: "FastBody") -> "FastBody":
        """One way of both; of frames in which both were seen, this one's sightings."""
        sightings = {**other.path.sightings, **self.path.sightings}
        return replace(self, path=Path(dict(sorted(sightings.items()))), radius=max(self.radius, other.radius))

    def track(self, num_knots: int, spacing: float, scale: float | None = None) -> Tensor:
        """Where it is at evenly spaced times, (num_knots, 3), float64: `NOWHERE` while nothing is known of it.

        Short gaps are filled, and a way that ends near an end of the film goes on to there.

        Args:
            num_knots: from time 0 to 1.
            spacing: of frames, in time.
            scale: see `Path.positions`.
        """
        knots, beside, reach = np.linspace(0, 1, num_knots), 1.01 / (num_knots - 1), (GAP + 1) * spacing
        seen = [sighting.time for sighting in self.path.sightings.values()]
        first = 0.0 if seen[0] <= reach else seen[0] - beside
        last = 1.0 if seen[-1] >= 1 - reach else seen[-1] + beside
        is_known = (knots >= first) & (knots <= last)
        for before, after in pairwise(seen):
            if after - before > 2 * reach:
                is_known &= (knots <= before + beside) | (knots >= after - beside)
        return torch.from_numpy(np.where(is_known[:, None], self.path.positions(knots, scale=scale), NOWHERE))


def fast_bodies(paths: Sequence[Path], min_speed: float) -> list[FastBody]:
    """Those of them that are too fast, longest first, and not what hardly fits."""
    found = []
    for path in sorted(paths, key=lambda path: -len(path.sightings)):
        seen = list(path.sightings.values())
        numbers = list(path.sightings)
        times = np.linspace(0, 1, FINE)
        places = path.positions(times)
        own = [_at(places, sighting.time) for sighting in seen]
        radii = [sighting.radius_at(place) for sighting, place in zip(seen, own)]
        moves = np.linalg.norm(np.diff(own, axis=0), axis=-1) / np.diff(numbers)
        misses = [sighting.miss(place) for sighting, place in zip(seen, own)]
        is_fast = np.median(moves) >= min_speed * np.median(radii)
        is_alone = np.mean([sighting.is_alone for sighting in seen]) >= ALONE
        if is_fast and np.median(misses) <= MOST_MISSED * np.median(radii):
            color = np.median([sighting.color for sighting in seen], axis=0)
            found.append(FastBody(path, float(np.quantile(radii, 0.75)), color, bool(is_alone)))
    return found


def joined_bodies(bodies: Sequence[FastBody], spacing: float) -> list[FastBody]:
    """Those that are alone, with what may be one body, lost on its way, put together.

    What is not alone may be a part of something larger, unless a body that is leads to it.
    """
    whole: list[FastBody] = []
    for body in sorted(bodies, key=lambda body: not body.is_alone):
        for number, other in enumerate(whole):
            if body.may_be(other) and (body.is_alone or other.leads_to(body, spacing)):
                whole[number] = other.and_then(body)
                break
        else:
            whole += [body] if body.is_alone else []
    return whole


def _at(places: Array, time: float) -> Array:
    """Between places (T, 3) at even times from 0 to 1."""
    number = time * (len(places) - 1)
    before = min(int(number), len(places) - 2)
    return places[before] + (number - before) * (places[before + 1] - places[before])
