"""The flow's benchmarks: rows say what they should, and errors are those of the truth."""

import pytest
import torch

from benchmarks.closed_flows import CLOSED_FLOWS
from benchmarks.flow_rows import smooth_network, solver_rows, variant_rows
from dnerf.deformations.solvers import SOLVERS


@pytest.mark.parametrize("name", CLOSED_FLOWS)
def test_closed_maps_are_the_flows_of_their_velocities(name: str) -> None:
    """d/dt of the map is the velocity at the mapped point, by central differences."""
    field = CLOSED_FLOWS[name]()
    positions, start, end = torch.rand(50, 3).double() * 2 - 1, torch.rand(50).double(), torch.rand(50).double()
    step = 1e-5
    slope = (field.carry(positions, start, end + step) - field.carry(positions, start, end - step)) / (2 * step)
    torch.testing.assert_close(slope, field(field.carry(positions, start, end), end), rtol=0, atol=1e-7)
    assert torch.equal(field.carry(positions, start, start), positions)


def test_solver_rows_show_the_error_falling_with_the_evaluations() -> None:
    rows = solver_rows(("rotation", "network"), num_points=64, steps=(4, 8), tolerances=(1e-3,), repeats=1)
    assert {row["solver"] for row in rows} == set(SOLVERS)
    for field in ("rotation", "network"):
        for solver, order in (("euler", 1), ("midpoint", 2), ("rk4", 4)):
            coarse, fine = (row for row in rows if row["field"] == field and row["solver"] == solver)
            assert fine["evaluations"] == 2 * coarse["evaluations"] == 8 * order
            assert fine["max_error"] < coarse["max_error"] / 2 ** (order - 0.5)
            assert fine["low_ms"] > 0


def test_the_network_is_always_the_same_and_moves_points_by_about_half_a_unit() -> None:
    first, second = smooth_network(), smooth_network()
    positions, times = torch.rand(500, 3) * 2 - 1, torch.rand(500)
    assert torch.equal(first(positions, times), second(positions, times))
    assert 0.1 < first(positions, times).norm(dim=-1).mean() < 2


def test_variant_rows_compare_with_the_first() -> None:
    names = (
        "displacement (4 x 128)",
        "flow, stationary, 1 midpoint step (3 x 128)",
        "flow, chain of 2 Euler steps (3 x 128)",
    )
    rows = variant_rows(names, num_samples=512, repeats=1, precision=None)
    assert [row["variant"] for row in rows] == list(names)
    assert [row["evaluations"] for row in rows] == [1, 2, 2]
    assert rows[0]["ratio"] == 1
    with pytest.raises(ValueError, match=r"names must be some of displacement .*; got magic"):
        variant_rows(("magic",))
