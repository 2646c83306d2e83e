"""Nodes of a control graph, placed where the body turns out to be."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_whole
from dnerf.deformations import ControlGraphDeformation, unwrapped
from dnerf.fields import DeformedField
from dnerf.samplers import OccupancyAware
from dnerf.training.callbacks import Callback
from dnerf.training.run import Run

DENSE = math.log(2) / 0.05  # half opaque in 0.05 units
MOST_POINTS = 1 << 13  # from which nodes are chosen


class PlaceNodes(Callback):
    """Spreads the nodes of a control graph over the canonical body, some times while it takes shape.

    Each node is as far as can be from those chosen before it, so that they lie evenly wherever there is density. Where
    there is less of that than there are nodes, they stay.

    Args:
        at: progress in [0, 1] of each time.
        num_probes: places in occupied cells at which density is looked for.

    Raises:
        ValueError: for no or too few probes; before the first step, for a model without such nodes or occupied cells.
    """

    def __init__(
        self, at: Sequence[float] = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4), *, num_probes: int = 1 << 15
    ) -> None:
        check_whole("num_probes", num_probes)
        self.at, self.num_probes = tuple(sorted(at)), num_probes
        self._done = torch.zeros((), dtype=torch.int64)  # of the times

    def on_train_begin(self, run: Run) -> None:
        """Forget earlier runs; ValueError for a model that cannot be served."""
        self._done.zero_()
        graph_of(run)
        if not isinstance(run.renderer.sampler, OccupancyAware):
            raise ValueError(f"PlaceNodes needs an occupancy-aware sampler, got {type(run.renderer.sampler).__name__}")

    @torch.no_grad()
    def on_step_end(self, run: Run) -> None:
        """Place the nodes if it is time."""
        wanted = sum(run.progress >= place for place in self.at)
        if wanted <= int(self._done):
            return
        self._done.fill_(wanted)
        (field, graph), sampler = graph_of(run), run.renderer.sampler
        assert isinstance(sampler, OccupancyAware)
        body = self._body(run, field, sampler)
        if len(body) >= len(graph.nodes):
            graph.place(body[farthest_points(body, len(graph.nodes))])
            run.renderer.invalidate()

    def state_dict(self) -> dict[str, Tensor]:
        """How often nodes were placed."""
        return {"done": self._done}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on with the next time."""
        self._done.copy_(state["done"])

    def _body(self, run: Run, field: DeformedField, sampler: OccupancyAware) -> Tensor:
        """Canonical places (N, 3) of much density."""
        device = run.renderer.device
        generator = torch.Generator(device).manual_seed(run.step)
        unit = torch.rand(self.num_probes, 5, generator=generator, device=device)
        positions, times = sampler.occupied_positions(unit)
        with run.renderer.autocast(device):
            canonical = unwrapped(field.deformation)(positions, times)
            density = field.canonical.density(canonical, times)
        return canonical[density > DENSE][:MOST_POINTS]


def graph_of(run: Run) -> tuple[DeformedField, ControlGraphDeformation]:
    """The field of a run's model, and its control graph; ValueError if it has none."""
    field = run.renderer.field
    found: nn.Module = field
    if isinstance(field, DeformedField):
        found = unwrapped(field.deformation)
        if isinstance(found, ControlGraphDeformation):
            return field, found
    raise ValueError(f"PlaceNodes needs deformation=control_graph, got {type(found).__name__}; leave it out")


def farthest_points(points: Tensor, count: int) -> Tensor:
    """Numbers (count,) of points (N, 3), N >= count, each the one farthest from those before it; the first is 0."""
    chosen = torch.zeros(count, dtype=torch.int64, device=points.device)
    distances = (points - points[0]).square().sum(-1)
    for i in range(1, count):
        chosen[i] = distances.argmax()
        distances = torch.minimum(distances, (points - points[chosen[i]]).square().sum(-1))
    return chosen
