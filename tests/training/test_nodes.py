"""Nodes of a control graph come to lie where there is density."""

import pytest
import torch
from small_runs import BOX, run_of, small_renderer

from dnerf.core.compositing import FieldOutput
from dnerf.deformations import CachedDeformation, ControlGraphDeformation
from dnerf.fields import DeformedField, RadianceField
from dnerf.rendering import Renderer
from dnerf.samplers import OccupancyGrid, OccupancySampler, StratifiedSampler
from dnerf.training import PlaceNodes, Run
from dnerf.training.nodes import farthest_points


class Ball(RadianceField):
    """Dense within half a unit of the origin."""

    def density(self, positions: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
        return 100.0 * (positions.norm(dim=-1) < 0.5)

    def forward(self, positions: torch.Tensor, directions: torch.Tensor, times: torch.Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), torch.ones_like(positions))


def run_with(place: PlaceNodes) -> Run:
    deformation = ControlGraphDeformation(BOX, 32, 4, hidden_features=16, num_layers=2)
    run = run_of(small_renderer(), callbacks={"place": place})
    field = DeformedField(CachedDeformation(deformation, BOX), Ball())
    run.renderer = Renderer(field, OccupancySampler(OccupancyGrid(BOX, 8), 0.1))
    place.on_train_begin(run)
    return run


def nodes(run: Run) -> torch.Tensor:
    return run.renderer.field.deformation.deformation.nodes


def test_nodes_spread_over_the_body_when_it_is_time() -> None:
    run = run_with(place := PlaceNodes((0.2, 0.4)))
    first = nodes(run).clone()
    for progress in (0.1, 0.3, 0.35):
        run.progress, before = progress, nodes(run).clone()
        place.on_step_end(run)
        assert torch.equal(before, nodes(run)) == (progress != 0.3)
    assert first.norm(dim=-1).amax() > 1
    assert nodes(run).norm(dim=-1).amax() <= 0.5
    # 32 balls of half this distance, which do not meet, fill a quarter of the body or more.
    distances = torch.cdist(nodes(run), nodes(run)) + 9 * torch.eye(32)
    assert 32 * (0.5 * distances.amin()) ** 3 >= 0.25 * 0.5**3


def test_nodes_stay_where_nothing_is_dense_enough() -> None:
    run = run_with(place := PlaceNodes((0.2,)))
    run.renderer.field.canonical.density = lambda positions, times: torch.zeros_like(times)
    before, run.progress = nodes(run).clone(), 0.3
    place.on_step_end(run)
    assert torch.equal(before, nodes(run))


def test_a_continued_run_goes_on_with_the_next_time() -> None:
    run = run_with(place := PlaceNodes((0.2, 0.4)))
    run.progress = 0.3
    place.on_step_end(run)
    again = PlaceNodes((0.2, 0.4))
    again.on_train_begin(run)
    again.load_state_dict(place.state_dict())
    before = nodes(run).clone()
    again.on_step_end(run)
    assert torch.equal(before, nodes(run))


def test_models_that_it_cannot_serve_are_named() -> None:
    run = run_of(small_renderer())
    with pytest.raises(ValueError, match="PlaceNodes needs deformation=control_graph, got DisplacementDeformation"):
        PlaceNodes().on_train_begin(run)
    run = run_with(PlaceNodes())
    run.renderer.sampler = StratifiedSampler(4)
    with pytest.raises(ValueError, match="PlaceNodes needs an occupancy-aware sampler, got StratifiedSampler"):
        PlaceNodes().on_train_begin(run)


def test_farthest_points_are_those_of_brute_force() -> None:
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    chosen = [0]
    while len(chosen) < 12:
        chosen.append(max(range(40), key=lambda i: min(float((points[i] - points[j]).norm()) for j in chosen)))
    assert farthest_points(points, 12).tolist() == chosen
