import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.backends import under

from dnerf.kernels import thin_out
from dnerf.kernels.thin_out import thin_out_reference


def samples_of_rays(counts, gap, seed=0, dtype=torch.float32):
    """Points on one ray after the other, steps of 0.2 to 1 times `gap`, and their rays' times."""
    generator = torch.Generator().manual_seed(seed)
    points, times = [torch.zeros(0, 3, dtype=dtype)], [torch.zeros(0, dtype=dtype)]
    for count in counts:
        origin, direction = torch.randn(2, 3, generator=generator, dtype=dtype)
        steps = gap * (0.2 + 0.8 * torch.rand(count, 1, generator=generator, dtype=dtype))
        points.append(origin + steps.cumsum(0) * direction / direction.norm())
        times.append(torch.rand((), generator=generator, dtype=dtype).expand(count))
    return torch.cat(points), torch.cat(times)


@settings(max_examples=50, deadline=None)
@given(
    counts=st.lists(st.integers(0, 30), max_size=8),
    gap=st.sampled_from([1e-3, 0.03, 0.05, 0.2]),
    doubled=st.integers(0, 5),
    seed=st.integers(0, 9),
)
def test_numba_equals_reference_on_random_rays(counts, gap, doubled, seed):
    points, times = samples_of_rays(counts, gap, seed)
    if len(points):  # as samples are padded
        points = torch.cat([points, points[-1:].expand(doubled, 3)])
        times = torch.cat([times, times[-1:].expand(doubled)])
    for both in zip(under("numba", thin_out, points, times, 0.1), thin_out_reference(points, times, 0.1), strict=True):
        assert torch.equal(*both)


@pytest.mark.parametrize("gap", [0.01, 0.04, 0.09])
def test_all_points_lie_where_they_are_said_to_between_near_ones_of_their_time(gap, backend):
    points, times = samples_of_rays([1, 40, 0, 2, 100, 3], gap, dtype=torch.float64)
    chosen, before, fractions = thin_out(points, times, 0.1)
    assert len(chosen) < len(points)
    start, end = points[chosen][before], points[chosen][(before + 1).clamp(max=len(chosen) - 1)]
    torch.testing.assert_close(torch.lerp(start, end, fractions[:, None]), points)
    between = fractions > 0
    assert bool(((end - start).norm(dim=-1)[between] < 0.2).all())
    assert all(torch.equal(times[chosen][which], times) for which in (before, before + between))


def test_a_long_row_is_evaluated_once_per_spacing_and_at_its_end():
    points = torch.zeros(1001, 3, dtype=torch.float64)
    points[:, 1] = torch.arange(1001) / 1000
    chosen, _, _ = thin_out(points, torch.zeros(1001, dtype=torch.float64), 0.0995)
    places = points[chosen, 1]
    assert len(chosen) == 12  # 0, the first after each of 10 multiples, 1
    torch.testing.assert_close(places[1:-1], (torch.arange(1, 11) * 0.0995 * 1000).ceil().double() / 1000)


@pytest.mark.parametrize(
    ("points", "times"),
    [
        ([], []),
        ([[0, 0, 0]], [0.5]),
        ([[0, 0, 0], [0.01, 0, 0]], [0.5, 0.5]),
        ([[0, 0, 0], [0.01, 0, 0], [0.02, 0.001, 0]], [0.5] * 3),  # a corner
        ([[0, 0, 0], [0.02, 0, 0], [0.01, 0, 0]], [0.5] * 3),  # and back
        ([[0, 0, 0], [0.01, 0, 0], [0.02, 0, 0]], [0.5, 0.6, 0.5]),
        ([[0, 0, 0], [0.2, 0, 0], [0.4, 0, 0]], [0.5] * 3),  # too far
        ([[0, 0, 0], [float("nan"), 0, 0], [0.02, 0, 0]], [0.5] * 3),
        ([[0, 0, 0], [float("inf"), 0, 0], [float("inf"), 0, 0]], [0.5] * 3),
    ],
)
def test_points_without_neighbours_on_both_sides_are_all_chosen(points, times, backend):
    chosen, before, fractions = thin_out(torch.tensor(points).reshape(-1, 3), torch.tensor(times), 0.1)
    assert chosen.tolist() == before.tolist() == list(range(len(times)))
    assert fractions.tolist() == [0] * len(times)


@pytest.mark.parametrize(
    ("times", "spacing", "message"),
    [
        *((torch.zeros(2), spacing, "spacing must be > 0") for spacing in (0.0, -1.0, float("nan"))),
        (torch.zeros(2, 1), 0.1, r"times must have shape \(2,\), got \(2, 1\)"),
    ],
)
def test_what_does_not_fit_is_refused(times, spacing, message):
    with pytest.raises(ValueError, match=message):
        thin_out(torch.zeros(2, 3), times, spacing)
