import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dnerf.visualization import interpolate


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("kind", ["smooth", "linear"])
def test_curve_goes_through_its_keys_stays_at_its_ends_and_keeps_straight_lines(kind: str) -> None:
    knots, values = f64(0, 1, 1.5, 4), torch.randn(4, 3, dtype=torch.float64)
    torch.testing.assert_close(interpolate(knots, values, knots, kind), values, rtol=0, atol=1e-14)
    outside = interpolate(knots, values, f64(-3, 9), kind)
    torch.testing.assert_close(outside, values[[0, -1]], rtol=0, atol=1e-14)
    knots, at = f64(0, 0.2, 1.5, 2), torch.linspace(0, 2, 101, dtype=torch.float64)
    curve = interpolate(knots, (3 - 2 * knots)[:, None], at, kind)
    torch.testing.assert_close(curve[:, 0], 3 - 2 * at, rtol=0, atol=1e-14)


def test_one_key_is_constant() -> None:
    assert interpolate(f64(2), f64(5, 6)[None], f64(0, 2, 7)).tolist() == [[5, 6]] * 3


@given(st.lists(st.floats(-10, 10), min_size=2, max_size=7), st.integers(0, 10**6))
def test_smooth_curve_never_overshoots(heights: list[float], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    knots = (0.05 + torch.rand(len(heights), generator=generator, dtype=torch.float64)).cumsum(0)
    for i in range(len(heights) - 1):
        at = torch.lerp(knots[i], knots[i + 1], torch.linspace(0, 1, 33, dtype=torch.float64))
        piece = interpolate(knots, f64(*heights)[:, None], at)[:, 0]
        low, high = sorted(heights[i : i + 2])
        assert piece.min() >= low - 1e-12
        assert piece.max() <= high + 1e-12
        steps = piece.diff() * (1 if heights[i + 1] >= heights[i] else -1)
        assert steps.min() >= -1e-12


def test_smooth_curve_has_a_continuous_slope() -> None:
    knots, values = f64(0, 1, 1.4, 3, 3.5), f64(0, 1, 1.2, 4, 3)[:, None]
    h = 1e-6
    for knot in knots[1:-1]:
        at = torch.stack([knot - h, knot, knot + h])
        left, right = interpolate(knots, values, at)[:, 0].diff() / h
        assert abs(left - right) < 1e-4


def test_smooth_curve_converges_to_a_smooth_function() -> None:
    errors = []
    for count in (9, 17, 33, 65):
        knots = torch.linspace(0.1, 1.4, count, dtype=torch.float64)
        at = torch.linspace(0.1, 1.4, 1001, dtype=torch.float64)
        errors.append((interpolate(knots, knots.sin()[:, None], at)[:, 0] - at.sin()).abs().max())
    orders = torch.stack(errors).log2().diff().neg()
    # harmonic means give the tangents to second order, so the curve is of third
    assert (orders > 2.6).all()


def test_bad_knots_are_refused() -> None:
    with pytest.raises(ValueError, match="knots must be strictly increasing"):
        interpolate(f64(0, 0), torch.zeros(2, 1), f64(0))
    with pytest.raises(ValueError, match="kind must be one of smooth, linear"):
        interpolate(f64(0, 1), torch.zeros(2, 1), f64(0), "cubic")
    with pytest.raises(ValueError, match=r"values must have shape \(2, C\)"):
        interpolate(f64(0, 1), torch.zeros(3, 1), f64(0))
