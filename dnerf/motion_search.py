"""Motion read off a trained field: where what it shows goes, of which its deformation does not know.

A field whose space-time volumes have joined (`dnerf.fields.SpaceTimeVolumes`) shows bodies where they are at each time
without saying that they are the same ones: its pictures are right, its deformation leaves those bodies where they are.
So a velocity field is sought in the world along whose tracks what the field holds stays the same; if bodies are
carried, whose motion is known, behind these.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn
from tqdm import tqdm

from dnerf.checks import check_positive
from dnerf.data.frames import Frames
from dnerf.deformations import CarriedBodies, Deformation, FlowDeformation
from dnerf.deformations.solvers import fixed_steps
from dnerf.fields import DeformedField, SpaceTimeVolumes
from dnerf.motion import carry
from dnerf.optimizers import AdamMuon
from dnerf.renderer import Renderer
from dnerf.seen_matter import SeenMatter, seen_matter

Contents = Callable[[Tensor, Tensor], Tensor]
"""What a field holds, (M, 4), at positions (M, 3) and times (M,)."""

Carried = Callable[[Tensor, Tensor, Tensor, float], Tensor]
"""Where positions (M, 3) at times (M,) are at other times (M,), so far apart at most."""

CHUNK = 16384  # points that are judged
LOOKING = (0.0, 0.0, 1.0)
"""Direction in which contents are looked at: one for all, so that highlights stay where they are."""

GROWS = (0.25, 0.9)
"""Fractions of a search between which the time grows over which points are followed."""

MOST_LEFT = 0.9
"""Share of the change along the deformation's tracks above which a flow's tracks are none that were found."""


@dataclass(frozen=True)
class FoundMotion:
    """What a search has come to.

    Args:
        deformed: mean squared change of contents between two times along the deformation's tracks.
        carried: along the flow's.
    """

    deformed: float
    carried: float

    @property
    def is_motion(self) -> bool:
        """Whether the flow's tracks are the better ones; not if they are not finite."""
        return self.carried < MOST_LEFT * self.deformed


def has_unknown_motion(renderer: Renderer) -> bool:
    """Whether the model shows matter of whose motion it does not know: space-time volumes joined, and no search was."""
    field = renderer.field
    return isinstance(field, DeformedField) and not field.has_found_motion and _remembers(field)


def _remembers(field: DeformedField) -> bool:
    return any(isinstance(part, SpaceTimeVolumes) and part.has_joined for part in field.canonical.modules())


class MotionSearch:
    """Fits the `motion_flow` of a `DeformedField` to what the field holds, which stays as it is.

    Points of matter that training pixels show, moved at random for there to be edges on both sides, are carried by the
    velocity from their time t to another time s. What the field holds there and then is compared with what it held:
    squared differences of opacity (of an interval of `length`) and of colour times opacity. The gradient goes through
    the carried positions into the velocity alone. The time |s - t| is at most `spans[0]` at first, over which bodies
    overlap with themselves, and `spans[1]` in the end, over which small errors of the velocity add up.

    A body of one colour may turn about itself without any change: of such turns tracks know nothing.

    Source: constancy of what is seen along its motion, as of optical flow (Horn and Schunck 1981); deviation: of a
    reconstructed field in three dimensions, over longer and longer times.

    Args:
        num_steps: of the optimiser.
        num_points: of each step.
        num_rays: through random training pixels, where matter is looked for.
        learning_rate: of the velocity's matrices, which take orthogonalised steps (`AdamMuon`); a quarter of it for
            its last layer; all falls to a twentieth.
        spans: of time, see above, in (0, 1].
        step: longest step in time of the midpoint rule.
        jitter: standard deviation of random moves, in world units.
        length: of the interval whose opacity counts, in world units.
        still_weight: of the squared speed, in (unit of time / world unit)^2: what changes nowhere stays.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self,
        num_steps: int = 600,
        num_points: int = 1024,
        num_rays: int = 60_000,
        *,
        learning_rate: float = 4e-2,
        spans: Sequence[float] = (0.02, 0.3),
        step: float = 0.02,
        jitter: float = 0.04,
        length: float = 0.05,
        still_weight: float = 1e-4,
    ) -> None:
        for name, value in (
            ("num_steps", num_steps), ("num_points", num_points), ("num_rays", num_rays), ("step", step),
            ("learning_rate", learning_rate), ("length", length),
        ):  # fmt: skip
            check_positive(name, value)
        for name, value in (("jitter", jitter), ("still_weight", still_weight)):
            check_positive(name, value, allow_zero=True)
        if len(spans) != 2 or not 0 < spans[0] <= spans[1] <= 1:
            raise ValueError(f"spans must be two times, 0 < first <= last <= 1, got {list(spans)}")
        self.num_steps = num_steps
        self.num_points = num_points
        self.num_rays = num_rays
        self.learning_rate = learning_rate
        self.spans = (float(spans[0]), float(spans[1]))
        self.step = step
        self.jitter = jitter
        self.length = length
        self.still_weight = still_weight

    def __call__(
        self, renderer: Renderer, frames: Frames, *, seed: int = 0, progress_bar: bool = False
    ) -> FoundMotion | None:
        """Search; what is found becomes the field's `motion`, if nothing is all is as it was.

        Args:
            renderer: trained, its field a `DeformedField` with a `motion_flow` at rest.
            frames: whose pixels say where matter is.
            seed: of all randomness.
            progress_bar: whether to draw one on standard error.

        Returns:
            What came of it; None if there is nothing to look for: the deformation is all motion there is, since no
            space-time volumes have joined, or pictures show nothing.

        Raises:
            ValueError: for a field without a place for what is found, or a flow whose clock is not running.
        """
        field = renderer.field
        flow = field.motion_flow if isinstance(field, DeformedField) else None
        if not isinstance(field, DeformedField) or flow is None:
            raise ValueError("a motion search needs a DeformedField with a motion_flow, this field has none")
        if flow.clock != "running":
            raise ValueError(f"motion_flow.clock must be running, points are carried so, got {flow.clock}")
        if not _remembers(field):
            return None
        generator = torch.Generator(renderer.device).manual_seed(seed)
        contents = partial(self._contents, renderer)
        at_rest = {name: value.clone() for name, value in flow.state_dict().items()}
        with _learning_only(flow, renderer):
            seen = seen_matter(renderer, frames.to(renderer.device), self.num_rays, generator)
            if not len(seen.times):
                return None
            carried = partial(self._carried, flow, field.bodies)
            self._fit(flow, field.bodies, carried, contents, seen, generator, progress_bar=progress_bar)
            found = self._judged(field.modelled_motion, carried, contents, seen, generator)
        field.set_found_motion(found.is_motion)
        if not found.is_motion:
            flow.load_state_dict(at_rest)
        return found

    def _fit(
        self,
        flow: FlowDeformation,
        bodies: CarriedBodies | None,
        carried: Carried,
        contents: Contents,
        seen: SeenMatter,
        generator: torch.Generator,
        *,
        progress_bar: bool,
    ) -> None:
        optimizer = AdamMuon.of(
            flow,
            {"": self.learning_rate, "*mlp.output": 0.25 * self.learning_rate},
            orthogonal=["velocity"],
            betas=(0.9, 0.99),
            eps=1e-15,
        )
        for number in tqdm(range(self.num_steps), desc="motion", disable=not progress_bar, leave=False):
            progress = number / self.num_steps
            optimizer.set_rates(0.05**progress)
            positions, times = self._drawn(seen, self.num_points, generator)
            ends, span = self._ends(times, progress, generator)
            with torch.no_grad():
                before = contents(positions, times)
            moved = carried(positions, times, ends, span)
            change = (contents(moved, ends) - before).square().sum(-1).mean()
            behind = positions if bodies is None else bodies(positions, times)
            speed = flow.velocity(behind, times).square().sum(-1).mean()
            optimizer.zero_grad(set_to_none=True)
            (change + self.still_weight * speed).backward()
            optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    def _drawn(self, seen: SeenMatter, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Positions (count, 3) at or near seen matter, and their times (count,)."""
        chosen = torch.randint(len(seen.times), (count,), generator=generator, device=seen.times.device)
        moves = torch.randn(count, 3, generator=generator, device=seen.times.device)
        return seen.positions[chosen] + self.jitter * moves, seen.times[chosen]

    def _ends(self, times: Tensor, progress: float, generator: torch.Generator) -> tuple[Tensor, float]:
        """Other times (M,), thrown back at 0 and 1, and how far from `times` they are at most."""
        grown = min(max((progress - GROWS[0]) / (GROWS[1] - GROWS[0]), 0.0), 1.0)
        span = self.spans[0] * (self.spans[1] / self.spans[0]) ** grown
        ends = times + span * (2 * torch.rand(len(times), generator=generator, device=times.device) - 1)
        return 1 - (1 - ends.abs()).abs(), span

    def _carried(
        self,
        flow: FlowDeformation,
        bodies: CarriedBodies | None,
        positions: Tensor,
        times: Tensor,
        ends: Tensor,
        span: float,
    ) -> Tensor:
        """Positions (M, 3) at times (M,) where they are at the ends (M,): the flow goes on behind the bodies."""
        lengths = ends - times

        def velocity(s: float | Tensor, places: Tensor) -> Tensor:
            return lengths[:, None] * flow.velocity(places, times + s * lengths)

        if bodies is not None:
            positions = bodies(positions, times)
        moved = fixed_steps("midpoint", velocity, positions, math.ceil(span / self.step))
        return moved if bodies is None else bodies.inverse(moved, ends)

    def _contents(self, renderer: Renderer, positions: Tensor, times: Tensor) -> Tensor:
        """Opacity, and colour times opacity, (M, 4)."""
        with renderer.autocast(positions.device):
            output = renderer.field(positions, positions.new_tensor(LOOKING).expand_as(positions), times)
        opacity = -torch.expm1(-self.length * output.density.float())[:, None]
        return torch.cat([opacity, opacity * output.rgb.float()], dim=-1)

    @torch.no_grad()
    def _judged(
        self,
        deformation: Deformation,
        carried: Carried,
        contents: Contents,
        seen: SeenMatter,
        generator: torch.Generator,
    ) -> FoundMotion:
        """Change of contents over times up to the longest span, along the deformation's tracks and the flow's."""
        positions, times = self._drawn(seen, CHUNK, generator)
        ends, span = self._ends(times, 1.0, generator)
        here = contents(positions, times)
        moved = (carry(deformation, positions, times, ends)[0], carried(positions, times, ends, span))
        changes = (float((contents(places, ends) - here).square().sum(-1).mean()) for places in moved)
        return FoundMotion(*changes)


@contextmanager
def _learning_only(part: nn.Module, renderer: Renderer) -> Iterator[None]:
    """While it lasts the renderer is in evaluation mode, and parameters of that part alone take gradients."""
    learns = [(parameter, parameter.requires_grad) for parameter in renderer.parameters()]
    modes = [(module, module.training) for module in renderer.modules()]
    renderer.eval()
    renderer.requires_grad_(False)
    part.requires_grad_(True)
    try:
        yield
    finally:
        for parameter, does in learns:
            parameter.requires_grad_(does)
        for module, mode in modes:
            module.training = mode
