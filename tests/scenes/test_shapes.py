"""Shapes: crossings agree with the inside test, at the hard cases too; normals point outwards."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dnerf.scenes import Ball, Box, Capsule, Shape

SHAPES: list[Shape] = [Ball(0.7), Box((0.3, 0.9, 0.05)), Capsule(0.2, (0.0, 0.0, -0.5)), Capsule(0.1, (0.3, -0.4, 0.2))]

every_shape = pytest.mark.parametrize("shape", SHAPES, ids=str)


def row(*values: float) -> Tensor:
    return torch.tensor([values], dtype=torch.float64)


def random_lines(count: int) -> tuple[Tensor, Tensor]:
    """Lines past the origin, from outside and inside, with directions of any length."""
    origins = torch.randn(count, 3, dtype=torch.float64)
    targets = 0.5 * torch.randn(count, 3, dtype=torch.float64)
    return origins, (targets - origins) * torch.rand(count, 1, dtype=torch.float64)


@every_shape
def test_points_between_the_crossings_are_inside_and_others_are_not(shape: Shape) -> None:
    origins, directions = random_lines(4000)
    enter, leave = shape.intersect(origins, directions)
    hits = leave > enter
    assert 0.02 < hits.double().mean() < 0.98
    for share, expected in ((-1e-6, False), (1e-6, True), (0.5, True), (1 - 1e-6, True), (1 + 1e-6, False)):
        points = origins + (enter + share * (leave - enter))[:, None] * directions
        assert (shape.contains(points[hits]) == expected).all()
    steps = torch.linspace(-20, 20, 401, dtype=torch.float64)[:, None, None]
    assert not shape.contains(origins[~hits] + steps * directions[~hits]).any()


@every_shape
def test_bounds_hold_the_shape_tightly(shape: Shape) -> None:
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in shape.bounds)
    points = 3 * torch.rand(400_000, 3, dtype=torch.float64) - 1.5
    inside = points[shape.contains(points)]
    slack = torch.minimum(inside.amin(0) - low, high - inside.amax(0))
    assert ((slack >= 0) & (slack < 0.1)).all()  # random points come this close


@every_shape
def test_excess_has_a_slope_of_at_most_one(shape: Shape) -> None:
    a, b = (2 * torch.rand(3000, 3, dtype=torch.float64) - 1 for _ in range(2))
    difference = (shape.excess(a) - shape.excess(b)).abs()
    assert (difference <= (a - b).norm(dim=-1) + 1e-15).all()


@every_shape
def test_normals_have_length_at_most_one_and_point_outwards(shape: Shape) -> None:
    origins, directions = random_lines(4000)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    enter, leave = shape.intersect(origins, directions)
    surface = (origins + enter[:, None] * directions)[leave > enter + 1e-3]
    normals = shape.normals(surface)
    assert (normals.norm(dim=-1) < 1.01).all()
    assert not shape.contains(surface + 0.02 * normals).any()


@pytest.mark.parametrize("axis", [0, 1, 2])
@every_shape
def test_lines_along_an_axis(shape: Shape, axis: int) -> None:
    origin = torch.tensor(shape.bounds, dtype=torch.float64).mean(0, keepdim=True)
    direction = torch.eye(3, dtype=torch.float64)[axis : axis + 1]
    enter, leave = shape.intersect(origin, direction)
    assert (torch.isfinite(enter) & torch.isfinite(leave)).all()
    assert shape.contains(origin + (0.999999 * leave)[:, None] * direction).all()
    assert not shape.contains(origin + (1.000001 * leave)[:, None] * direction).any()
    enter, leave = shape.intersect(origin + 5 * direction.roll(1, dims=-1), direction)
    assert (enter >= leave).all()


def test_line_along_a_capsules_axis_runs_from_tip_to_tip() -> None:
    capsule = Capsule(0.2, (0.0, 0.0, 0.5))
    enter, leave = capsule.intersect(row(0, 0, -3), row(0, 0, 1))
    assert (enter.item(), leave.item()) == pytest.approx((2.8, 3.7), abs=1e-15)
    enter, leave = capsule.intersect(row(0.12, 0, -3), row(0, 0, 2))
    assert (enter.item(), leave.item()) == pytest.approx((0.5 * (3 - 0.16), 0.5 * (3.5 + 0.16)), abs=1e-15)


@given(st.floats(1e-17, 1e-3))
def test_line_nearly_along_a_capsules_axis_is_stable(tilt: float) -> None:
    enter, leave = Capsule(0.2, (0.0, 0.0, 0.5)).intersect(row(0.05, 0, 0.25), row(tilt, 0, 1))
    chord = 0.25 + math.sqrt(0.2**2 - 0.05**2)
    # A tilted line ends elsewhere by about the tilt times the shape's size.
    assert (enter.item(), leave.item()) == pytest.approx((-chord, chord), abs=1e-14 + 0.5 * tilt)


@given(st.floats(1e-15, 0.5))
def test_ball_chord_is_accurate_down_to_grazing_rays(gap: float) -> None:
    enter, leave = Ball(1.0).intersect(row(-4, 0, 1 - gap), row(1, 0, 0))
    offset = 1 - gap
    truth = 2 * math.sqrt((1 - offset) * (1 + offset))
    assert (leave - enter).item() == pytest.approx(truth, abs=2e-15)  # rounding of the distances 4 -+ chord / 2


def test_ball_far_away_keeps_its_digits() -> None:
    enter, leave = Ball(1e-3).intersect(row(-1000, 0, 5e-4), row(1, 0, 0))
    assert (leave - enter).item() == pytest.approx(2e-3 * math.sqrt(0.75), abs=3e-13)  # ulp of 1000


@pytest.mark.parametrize("make", [lambda: Ball(0.0), lambda: Box((1.0, -1.0, 1.0)), lambda: Capsule(0.1, (0.0,) * 3)])
def test_shapes_without_volume_are_refused(make) -> None:
    with pytest.raises(ValueError, match="must be > 0"):
        make()
