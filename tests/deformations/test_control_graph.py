"""Nodes that carry what is near them, beyond the contract of all deformations."""

import pytest
import torch
from torch import Tensor

from dnerf.core.geometry import so3_exp
from dnerf.deformations import ControlGraphDeformation
from dnerf.deformations.control_graph import MOST_TIMES, ROUND_TO

BOX = ((-1.0, -1.0, -1.0), (1.0, 2.0, 1.0))


def small_graph(**settings: float) -> ControlGraphDeformation:
    torch.manual_seed(0)
    graph = ControlGraphDeformation(BOX, 32, 4, hidden_features=16, num_layers=2, **settings).double()
    with torch.no_grad():
        graph.shares.output.weight.normal_(std=0.5)
    return graph


def some_points(count: int = 50) -> tuple[Tensor, Tensor]:
    return 4 * torch.rand(count, 3, dtype=torch.float64) - 2, torch.rand(count, dtype=torch.float64)


def test_nodes_that_move_as_one_rigid_body_carry_all_space_so(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = small_graph()
    turn, travel = torch.tensor([0.3, -0.5, 0.2]).double(), torch.tensor([0.1, 0.4, -0.2]).double()

    def motions(times: Tensor) -> Tensor:
        """Turned by an angle that grows with time, about the origin, and moved."""
        rotations = so3_exp(times[:, None] * turn)
        halves = torch.tan(0.5 * times[:, None] * turn.norm()) * turn / turn.norm()
        travels = graph.nodes @ rotations.mT + times[:, None, None] * travel - graph.nodes
        return torch.cat([halves[:, None].expand_as(travels), travels], dim=-1)

    monkeypatch.setattr(graph, "motions", motions)
    positions, times = some_points()
    back = (so3_exp(times[:, None] * turn) @ graph(positions, times)[..., None])[..., 0] + times[:, None] * travel
    torch.testing.assert_close(back, positions)


def test_a_node_takes_along_what_is_at_it() -> None:
    """Where nodes are at a time, points return to where they rest; others around pull but little."""
    graph = small_graph(reach=0.05)
    time = torch.tensor([0.7], dtype=torch.float64)
    places = graph.nodes + graph.motions(time)[0, :, 3:]
    torch.testing.assert_close(graph(places, time.expand(32)), graph.nodes, rtol=0, atol=1e-3)


def test_nodes_placed_anew_move_by_the_same_networks() -> None:
    graph = small_graph()
    nodes, times = torch.rand(32, 3, dtype=torch.float64), torch.tensor([0.2, 0.9], dtype=torch.float64)
    graph.place(graph.nodes.flip(0))
    flipped = graph.motions(times)
    graph.place(graph.nodes.flip(0))
    torch.testing.assert_close(flipped.flip(1), graph.motions(times))
    spread = float(graph.radius)
    graph.place(0.5 * graph.nodes)
    assert float(graph.radius) == pytest.approx(0.5 * spread)
    graph.place(nodes)
    assert torch.equal(graph.state_dict()["nodes"], nodes)
    with pytest.raises(ValueError, match="positions must have shape"):
        graph.place(nodes[:5])


def test_very_many_times_are_rounded_to_near_ones() -> None:
    graph = small_graph()
    positions, times = some_points(MOST_TIMES + 1)
    rounded = (times * ROUND_TO).round() / ROUND_TO
    torch.testing.assert_close(graph(positions, times), graph(positions, rounded))
    assert torch.equal(graph(positions[:9], times[:9]), graph(positions[:9], times[:9]))


def test_nodes_begin_evenly_spread_over_the_box() -> None:
    nodes = ControlGraphDeformation(BOX, 512).nodes
    unit = (nodes - torch.tensor(BOX[0])) / torch.tensor([2.0, 3.0, 2.0])
    assert ((unit < 0.5).sum(0) - 256).abs().amax() <= 4  # at random it would be some 11
    for quarter in range(4):
        assert (((unit * 4).long() == quarter).sum(0) - 128).abs().amax() <= 4


@pytest.mark.parametrize("settings", [{"num_nodes": 4}, {"num_courses": 0}, {"reach": 0.0}])
def test_numbers_out_of_range_are_named(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        ControlGraphDeformation(BOX, **settings)
