"""Small bodies that move by about their own size from frame to frame, each carried along a track of its own."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from dnerf.checks import check_positive, check_shape
from dnerf.deformations.base import Deformation, check_positions_times

NOWHERE = 1e4
"""Coordinate of a track while its body is not there; nothing is shown half as far out or further."""
LEAST_KNOTS = 4  # of a path that may bend
LEARNT_WITH = 3.0  # knots: standard deviation of the weights with which they share gradients
ROUNDING = 1e-3  # of a radius, by which a line may seem to miss a ball


class CarriedBodies(nn.Module):
    """Exchanges the ball of space around each body, wherever that is at the time, with one at a place of its own.

    A field and a deformation behind it then see a fast body at rest, at its home, which has to be an empty place off
    all tracks; what is empty there lies around the body instead. At each time the map permutes the points of space: it
    moves balls as they are and changes nothing else, so it is its own inverse (of several bodies: the exchanges in
    reverse order). While a body is not there, its track is `NOWHERE`, and whoever asks at home is sent there.

    Tracks are learnt from samples near the body. In training mode a knot shares its gradient with those around it
    (`LEARNT_WITH`): a moment that one camera sees says nothing of the depth, and knots that learn by themselves lose
    the smooth path with which they began.
    Source: gradients in a smoother inner product (Neuberger, "Sobolev Gradients and Differential Equations", 1997).

    Args:
        max_bodies: for how many there is room.
        num_knots: of each track, evenly over times from 0 to 1; positions in between are interpolated linearly.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(self, max_bodies: int = 8, num_knots: int = 101) -> None:
        super().__init__()
        check_positive("max_bodies", max_bodies)
        if num_knots < LEAST_KNOTS:
            raise ValueError(f"num_knots must be at least {LEAST_KNOTS}, got {num_knots}")
        self.tracks = nn.Parameter(torch.zeros(max_bodies, num_knots, 3))
        self.register_buffer("homes", torch.zeros(max_bodies, 3))
        self.register_buffer("radii", torch.zeros(max_bodies))
        self.register_buffer("searched", torch.tensor(False))
        apart = torch.arange(num_knots)[:, None] - torch.arange(num_knots)
        self.register_buffer("shares", torch.exp(-0.5 * (apart / LEARNT_WITH) ** 2), persistent=False)
        self.homes: Tensor
        self.radii: Tensor
        self.searched: Tensor
        self.shares: Tensor
        self._recall()
        self.register_load_state_dict_post_hook(lambda module, _: module._recall())

    def _recall(self) -> None:
        """See how many bodies there are."""
        self.radii = self.radii.clone()  # elsewhere in memory: recorded graphs of the model are out of date
        self._num_bodies = int((self.radii > 0).sum())
        self._was_searched = bool(self.searched)

    @property
    def num_bodies(self) -> int:
        """How many are carried; without waiting for a device."""
        return self._num_bodies

    @property
    def was_searched(self) -> bool:
        """Whether `dnerf.body_search` has looked for them."""
        return self._was_searched

    def set_searched(self) -> None:
        """Say that it has."""
        self.searched.fill_(True)
        self._recall()

    @property
    def num_knots(self) -> int:
        """Of each track."""
        return self.tracks.shape[1]

    @torch.no_grad()
    def add(self, track: Tensor, home: Tensor, radius: float) -> None:
        """Carry one body more.

        Args:
            track: (num_knots, 3), its centres in world units.
            home: (3,), the centre of an empty ball, off all tracks and homes.
            radius: of the balls that are exchanged, in world units.

        Raises:
            ValueError: if there is no room, for shapes that do not fit, or if a home's ball meets another one, at a
                knot at least; tracks of two bodies may cross.
        """
        number = self.num_bodies
        if number == len(self.radii):
            raise ValueError(f"there is room for max_bodies = {number} bodies only")
        check_shape("track", track, (self.num_knots, 3))
        check_shape("home", home, (3,))
        check_positive("radius", radius)
        meetings = [("home must be {} away from the track", track - home, 2 * radius)]
        for other in range(number):
            reach = radius + float(self.radii[other])
            meetings += [
                (f"home must be {{}} away from home {other}", home - self.homes[other], reach),
                (f"home must be {{}} away from track {other}", self.tracks[other] - home, reach),
                (f"track must be {{}} away from home {other}", track - self.homes[other], reach),
            ]
        for expected, ways, reach in meetings:
            nearest = float(ways.norm(dim=-1).amin())
            if not nearest > reach:
                raise ValueError(f"{expected.format(f'{reach:.3g}')}, got {nearest:.3g}")
        self.tracks[number] = track
        self.homes[number] = home
        self.radii[number] = radius
        self._recall()

    def centers(self, number: int, times: Tensor) -> Tensor:
        """Where a body's centre is, (..., 3), at times (...,) in [0, 1]."""
        return self._along(self.tracks[number], times)

    def _along(self, track: Tensor, times: Tensor) -> Tensor:
        places = times.detach().to(track.dtype).clamp(0, 1) * (self.num_knots - 1)
        before = places.long().clamp_(max=self.num_knots - 2)
        return torch.lerp(track[before], track[before + 1], (places - before)[..., None])

    @staticmethod
    def is_nowhere(positions: Tensor) -> Tensor:
        """Whether positions (..., 3) that `forward` gave are of an absent body's home, (...,) bool."""
        return positions.abs().amax(-1) > NOWHERE / 2

    @torch.no_grad()
    def are_met(self, origins: Tensor, directions: Tensor, time: float) -> Tensor:
        """Which of the lines through origins (R, 3) along unit directions (R, 3) meet an exchanged ball, (R,) bool."""
        now = self.tracks.new_tensor(time)
        met = torch.zeros(len(origins), dtype=torch.bool, device=origins.device)
        for number in range(self.num_bodies):
            radius = self.radii[number] * (1 + ROUNDING)
            for center in (self.centers(number, now), self.homes[number]):
                way = center.to(origins.dtype) - origins
                along = (way * directions).sum(-1, keepdim=True)
                met |= (way - along * directions).norm(dim=-1) < radius
        return met

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Positions (..., 3) at times (...,) with the balls exchanged: bodies are at home."""
        is_learning = self.training and self.tracks.requires_grad and torch.is_grad_enabled()
        tracks = self._learnt_together() if is_learning else self.tracks
        return self._exchanged(positions, times, tracks, tracks, range(self.num_bodies))

    def inverse(self, positions: Tensor, times: Tensor) -> Tensor:
        """World positions (..., 3) at times (...,) of what `forward` gives.

        While a body is not there, this says where it may be: between its last place and its next one, or at the first
        or the last that is known.
        """
        return self._exchanged(positions, times, self.tracks, self._filled(), reversed(range(self.num_bodies)))

    def _learnt_together(self) -> Tensor:
        """Tracks as they are; a known knot's gradient goes to the known ones around it."""
        is_known = ~self.is_nowhere(self.tracks)
        shares = self.shares.to(self.tracks.dtype) * (is_known[:, :, None] & is_known[:, None])
        known = torch.where(is_known[..., None], self.tracks, 0)
        smooth = shares / shares.sum(-1, keepdim=True).clamp(min=1) @ known
        return self.tracks.detach() + (smooth - smooth.detach())

    def _filled(self) -> Tensor:
        """Tracks without `NOWHERE`."""
        knots = torch.arange(self.num_knots, device=self.tracks.device).expand(self.tracks.shape[:2])
        is_there = ~self.is_nowhere(self.tracks)
        before = torch.where(is_there, knots, -1).cummax(1).values
        after = torch.where(is_there, knots, self.num_knots).flip(1).cummin(1).values.flip(1)
        before, after = torch.where(before < 0, after, before), torch.where(after < self.num_knots, after, before)
        share = (knots - before).to(self.tracks.dtype) / (after - before).clamp(min=1)
        bodies = torch.arange(len(self.tracks), device=knots.device)[:, None]
        last = self.num_knots - 1  # of a track that is nowhere at all
        return torch.lerp(
            self.tracks[bodies, before.clamp(max=last)], self.tracks[bodies, after.clamp(0, last)], share[..., None]
        )

    def _exchanged(
        self, positions: Tensor, times: Tensor, tracks: Tensor, places: Tensor, numbers: Iterable[int]
    ) -> Tensor:
        """Positions with the balls around `tracks` exchanged; what is at home goes to where `places` say."""
        check_positions_times(positions, times)
        for number in numbers:
            home, center = self.homes[number].to(positions.dtype), self._along(tracks[number], times)
            place = center if places is tracks else self._along(places[number], times)
            center, place = center.to(positions.dtype), place.to(positions.dtype)
            with torch.no_grad():
                is_there = ~self.is_nowhere(center)[..., None]  # no two bodies meet while they are not
                is_away = ((positions - center).norm(dim=-1, keepdim=True) < self.radii[number]) & is_there
                is_home = (positions - home).norm(dim=-1, keepdim=True) < self.radii[number]
            positions = positions + is_away.to(home.dtype) * (home - center) + is_home.to(home.dtype) * (place - home)
        return positions


class CarriedDeformation(Deformation):
    """A deformation behind carried bodies: how matter moves where there are both. See `dnerf.motion.carry`.

    Args:
        bodies: which world positions meet first.
        deformation: of what they see then.
    """

    def __init__(self, bodies: CarriedBodies, deformation: Deformation) -> None:
        super().__init__()
        self.bodies = bodies
        self.deformation = deformation

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of world positions (..., 3) at times (...,)."""
        return self.deformation(self.bodies(positions, times), times)
