"""Small bodies that move too fast for a deformation to find: tracked through training's pictures, then carried."""

import logging
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dnerf.checks import as_box, check_positive
from dnerf.data.frames import Frames, composite_on
from dnerf.deformations import CarriedBodies
from dnerf.error_map import ErrorMap
from dnerf.fast_bodies import FastBody, fast_bodies, joined_bodies
from dnerf.fields import DeformedField, SpaceTimeVolumes
from dnerf.renderer import Renderer
from dnerf.samplers.occupancy_grid import OccupancyGrid
from dnerf.sightings import small_wrong_things
from dnerf.trajectories import PathSearch, Sighting

logger = logging.getLogger(__name__)

LAST = 0.9  # progress, after which what is found cannot be learnt any more
ROOM = 1.6  # times a body's radius, in which it is carried
BORDER = 0.02  # and so much more, in world units
ALSO_MISSING = 0.5  # of the error from which a body is missing, if another one is
FAR = 0.3  # of the tolerance, from a body's path: a sighting that hardly counts
CANDIDATES = 4096  # for a home
TIMES = 16  # at which it has to be empty
SHOWN = 10.0  # times the density from which on a sampler looks: until what is at home has grown
PLANTED = 2048  # points at home where matter is planted
PLANT_RATE = 2e-2  # of Adam's steps, 200 at most
PLANT_STEPS = 200
PLANT_DEPTH = 2.3  # logarithm of the density that is planted: about ten for each world unit
PLANT_LEFT = 0.25  # mean squared difference from it that is near enough
ROUNDS_AT_END = 8  # of as many points each
PIXELS_AT_ONCE = 1 << 13
POINTS = 20_000  # on a track, to which a sampler's attention is called


class BodySearch:
    """Looks once in training for small bodies that pictures show and the model does not, and lets it carry them.

    A body that moves by about its own size from frame to frame, each of another camera, overlaps with itself nowhere:
    no gradient leads a deformation to it. But single pictures show it, as a patch of wrong pixels where there is
    matter, and rays through the patches of a few frames in a row determine its path (`dnerf.trajectories`). What is
    found that way, and is too fast to be found by gradients, is given to the field's `CarriedBodies`: matter that moves
    along that path, of which nothing else is known yet. The deformation begins anew: it has bent what lies around such
    bodies in following them as far as it could. Which pixels are wrong is known from the `ErrorMap`; only the pixels of
    what would be carried are rendered, to see whether they are wrong indeed. Where space-time volumes have joined, they
    show such bodies, and nothing is looked for.

    Args:
        box: (2, 3) corners of where bodies may be, and homes are made, in world units.
        begin: progress of training, in [0, 1), from which it is due, once all frames are in; never in the last tenth.
        min_steps: before which it is not: until then everything is wrong.
        error: mean squared error of colours from which a block of pixels is wrong.
        missing: squared error above which most pixels of a body have to be, or of another one; then half of it will do.
        resolution: about which pictures are reduced to, in pixels along the longer side.
        max_share: of a picture, that a sighting may fill.
        min_speed: radii that a body moves between two frames, from which it is too fast.
        tolerance: see `PathSearch`, as a share of the longest side of the box.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self,
        box: Sequence[Sequence[float]],
        begin: float = 0.34,
        *,
        min_steps: int = 150,
        error: float = 0.02,
        missing: float = 0.04,
        resolution: int = 100,
        max_share: float = 0.02,
        min_speed: float = 0.4,
        tolerance: float = 0.033,
    ) -> None:
        for name, value in (
            ("error", error), ("missing", missing), ("resolution", resolution), ("max_share", max_share),
            ("tolerance", tolerance),
        ):  # fmt: skip
            check_positive(name, value)
        for name, value in (("min_steps", min_steps), ("min_speed", min_speed)):
            check_positive(name, value, allow_zero=True)
        if not 0 <= begin < LAST:
            raise ValueError(f"begin must be in [0, {LAST}), got {begin}")
        self.box = as_box(box)
        self.begin = begin
        self.min_steps = min_steps
        self.error = error
        self.missing = missing
        self.resolution = resolution
        self.max_share = max_share
        self.min_speed = min_speed
        self.tolerance = tolerance

    def is_due(self, step: int, progress: float, renderer: Renderer) -> bool:
        """Whether to look after a step, the `step`-th, at that progress; frames that are not in are the caller's."""
        bodies = bodies_of(renderer)
        is_new = bodies is not None and not bodies.was_searched
        return is_new and step >= self.min_steps and self.begin <= progress <= LAST

    @torch.no_grad()
    def __call__(self, step: int, renderer: Renderer, frames: Frames, error_map: ErrorMap) -> bool:
        """Look, and let the model carry what is found.

        Args:
            step: done.
            renderer: in training; its field has `CarriedBodies`.
            frames: of the training.
            error_map: of them.

        Returns:
            Whether there was any: the model now takes another path.
        """
        bodies = bodies_of(renderer)
        assert bodies is not None
        bodies.set_searched()
        if any(isinstance(part, SpaceTimeVolumes) and part.has_joined for part in renderer.modules()):
            return False
        times = frames.times.cpu()
        chosen = one_of_each_moment(times)
        times, sightings = times[chosen], self.sightings(frames, error_map)
        tolerance = self.tolerance * float((self.box[1] - self.box[0]).amax())
        search = PathSearch(self.box.tolist(), tolerance)
        paths = search([sightings[number] for number in chosen], times.tolist())
        spacing = float(times.diff().median()) if len(paths) else 0.0
        found = self._missing(joined_bodies(fast_bodies(paths, self.min_speed), spacing), renderer, frames)
        room = len(bodies.radii) - bodies.num_bodies
        tracks = [
            (body.track(bodies.num_knots, spacing, FAR * tolerance).to(bodies.tracks), ROOM * body.radius + BORDER)
            for body in found[:room]
        ]
        count = self._carry(tracks, renderer, bodies) if tracks else 0
        if count:
            logger.info("step %d: %d paths of small fast bodies found; the field carries them", step, count)
        return count > 0

    def _carry(self, tracks: Sequence[tuple[Tensor, float]], renderer: Renderer, bodies: CarriedBodies) -> int:
        """Carry bodies of those tracks and radii, as far as homes are found; how many those are.

        The deformation begins anew: what could not follow them has bent what lies around them.
        """
        assert isinstance(renderer.field, DeformedField)
        deformation, num_before = renderer.field.deformation, bodies.num_bodies
        before = {name: value.clone() for name, value in deformation.state_dict().items()}
        deformation.begin_anew()
        generator = torch.Generator().manual_seed(0)
        for track, radius in tracks:
            taken = list(zip(bodies.homes, bodies.radii.tolist()))[: bodies.num_bodies]
            home = self._home(renderer, radius, tracks, taken, generator)
            if home is not None:
                bodies.add(track, home, radius)
                self._plant(renderer, home, radius, generator)
                self._call_attention(renderer, bodies, generator)
        count = bodies.num_bodies - num_before
        if not count:
            deformation.load_state_dict(before)
        return count

    def sightings(self, frames: Frames, error_map: ErrorMap) -> list[list[Sighting]]:
        """What small things each frame shows where training's pictures are wrong, largest first."""
        return small_wrong_things(
            frames, error_map, error=self.error, resolution=self.resolution, max_share=self.max_share
        )

    def _missing(self, bodies: Sequence[FastBody], renderer: Renderer, frames: Frames) -> list[FastBody]:
        """Those that the model's pictures miss, and beside such ones those that they half miss.

        What is so fast that some of it is missing altogether is followed only by bending what lies around it.
        Source: thresholds of two heights (Canny 1986).
        """
        errors = [self._error_of(body, renderer, frames) for body in bodies]
        least = self.missing * (ALSO_MISSING if max(errors, default=0.0) > self.missing else 1)
        return [body for body, error in zip(bodies, errors, strict=True) if error > least]

    def _error_of(self, body: FastBody, renderer: Renderer, frames: Frames) -> float:
        """How wrong the model's pictures are all over a body, and not at its edges only, or beside its place.

        What the error map knows of a block are a few pixels. Hands that motion has all but found are wrong at their
        edges, and the model is left to find them.
        """
        pixels = torch.from_numpy(np.concatenate([sighting.pixels for sighting in body.path.sightings.values()]))
        errors = []
        renderer.eval()
        for part in pixels.to(frames.images.device).split(PIXELS_AT_ONCE):
            rays, rgba = frames.pixels(part)
            shown = renderer(rays)
            behind = torch.zeros_like(rays.directions) if shown.background is None else shown.background
            light, left = shown.rgb, (1 - shown.opacity)[:, None]
            # A white body is not seen before white.
            others = (torch.zeros_like(behind), torch.ones_like(behind)) if frames.has_alpha else (behind,)
            differences = [light + left * (other - behind) - composite_on(rgba, other) for other in others]
            errors.append(torch.stack(differences).square().mean((0, -1)))
        renderer.train()
        return float(torch.cat(errors).median())

    def _home(
        self,
        renderer: Renderer,
        radius: float,
        tracks: Sequence[tuple[Tensor, float]],
        taken: Sequence[tuple[Tensor, float]],
        generator: torch.Generator,
    ) -> Tensor | None:
        """The emptiest place found for a ball of that radius, off all tracks and homes (3,) that are taken."""
        box = self.box
        room = (box[1] - box[0] - 2 * radius).clamp(min=0)
        unit = torch.rand(CANDIDATES, 3, generator=generator)
        directions = torch.nn.functional.normalize(torch.randn(24, 3, generator=generator), dim=-1)
        around = radius * directions * torch.rand(24, 1, generator=generator) ** (1 / 3)
        homes = torch.lerp(box[0] + radius, box[0] + radius + room, unit).to(renderer.device)
        is_free = torch.ones(len(homes), dtype=torch.bool, device=homes.device)
        for places, other in [*tracks, *((home[None], other) for home, other in taken)]:
            is_free &= torch.cdist(homes, places).amin(1) > radius + max(other, radius) + BORDER
        homes = homes[is_free][: CANDIDATES // 8]
        if not len(homes):
            return None
        moments = torch.linspace(0, 1, TIMES, device=homes.device)
        points = (homes[:, None, None] + around.to(homes)[:, None]).expand(-1, -1, TIMES, 3)
        with renderer.autocast(homes.device):
            density = renderer.field.density(points.reshape(-1, 3), moments.expand(points.shape[:-1]).reshape(-1))
        return homes[density.reshape(len(homes), -1).amax(1).argmin()]

    def _plant(self, renderer: Renderer, home: Tensor, radius: float, generator: torch.Generator) -> None:
        """Let thin matter grow at home: where nothing is, nothing learns.

        Only features of places change (tables), not the networks that read them; a field without any is left alone.
        """
        field = renderer.field
        assert isinstance(field, DeformedField)
        tables = [value for name, value in field.canonical.named_parameters() if name.split(".")[-1] == "table"]
        if not tables:
            return
        unit = torch.rand(PLANTED, 1, generator=generator) ** (1 / 3)
        directions = torch.nn.functional.normalize(torch.randn(PLANTED, 3, generator=generator), dim=-1)
        places = home + (radius - BORDER) / ROOM * (directions * unit).to(home)
        times = torch.rand(PLANTED, generator=generator).to(home)
        canonical = field.deformation(places, times)
        optimizer = torch.optim.Adam(tables, lr=PLANT_RATE, betas=(0.9, 0.99), eps=1e-15)
        for _ in range(PLANT_STEPS):
            with torch.enable_grad():
                missing = torch.relu(PLANT_DEPTH - field.canonical.density(canonical, times).clamp(min=1e-30).log())
                loss = missing.square().mean()
                if float(loss.detach()) < PLANT_LEFT:
                    break
                gradients = torch.autograd.grad(loss, tables)
            for table, gradient in zip(tables, gradients, strict=True):
                table.grad = gradient
            optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    def _call_attention(self, renderer: Renderer, bodies: CarriedBodies, generator: torch.Generator) -> None:
        """Have the sampler look at the track of the latest body for a while: nothing is there yet."""
        if not isinstance(renderer.sampler, OccupancyGrid):
            return
        places, times = self._along(bodies, bodies.num_bodies - 1, POINTS, generator)
        renderer.sampler.observe(places, times, torch.full_like(times, SHOWN * renderer.sampler.threshold))
        renderer.sampler.decide()

    @torch.no_grad()
    def finish(self, renderer: Renderer) -> None:
        """At the end of training, let the sampler see bodies all along their tracks.

        Training knows them at the times of its frames, and fast ones are in a cell for a moment only.
        """
        bodies = bodies_of(renderer)
        if bodies is None or not isinstance(renderer.sampler, OccupancyGrid):
            return
        generator = torch.Generator().manual_seed(0)
        for number in range(bodies.num_bodies):
            for _ in range(ROUNDS_AT_END):
                places, times = self._along(bodies, number, POINTS, generator)
                with renderer.autocast(places.device):
                    density = renderer.field.density(places, times)
                renderer.sampler.observe(places, times, density)
        if bodies.num_bodies:
            renderer.sampler.decide()

    def _along(
        self, bodies: CarriedBodies, number: int, count: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Positions (N, 3) in the box, random ones of a body's balls of space, and times (N,); N <= count."""
        device = bodies.tracks.device
        times = torch.rand(count, generator=generator).to(device)
        directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
        unit = torch.rand(count, 1, generator=generator) ** (1 / 3)
        places = bodies.centers(number, times) + bodies.radii[number] * (directions * unit).to(device)
        is_inside = ((places >= self.box[0].to(device)) & (places <= self.box[1].to(device))).all(-1)
        return places[is_inside], times[is_inside]


def one_of_each_moment(times: Tensor) -> list[int]:
    """Frames of all different times (F,), in order; where several cameras see one moment, another one for the next."""
    moments, numbers = times.unique(return_inverse=True)
    frames = [(numbers == number).nonzero()[:, 0].tolist() for number in range(len(moments))]
    return [some[number % len(some)] for number, some in enumerate(frames)]


def bodies_of(renderer: Renderer) -> CarriedBodies | None:
    """The bodies that a model can carry; None if it has no room for any."""
    return renderer.field.bodies if isinstance(renderer.field, DeformedField) else None
