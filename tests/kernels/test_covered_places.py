import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.backends import under

from dnerf.kernels import covered_places
from dnerf.kernels.covered_places import covered_places_reference


def random_boxes(shape, count, reach, seed):
    """Boxes that begin anywhere, also beside the raster, up to `reach` long; some hold nothing."""
    generator = torch.Generator().manual_seed(seed)
    lows = torch.stack([torch.randint(-3, size + 4, (count,), generator=generator) for size in shape])
    return lows, lows + torch.randint(-1, reach, lows.shape, generator=generator)


@settings(max_examples=60, deadline=None)
@given(
    shape=st.tuples(*[st.integers(0, 12)] * 3),
    count=st.integers(0, 20),
    reach=st.sampled_from([1, 3, 40]),
    seed=st.integers(0, 99),
)
def test_both_versions_equal_a_loop_over_boxes(shape, count, reach, seed):
    lows, ends = random_boxes(shape, count, reach, seed)
    mask = torch.zeros(shape, dtype=torch.bool)
    for low, end in zip(lows.T.clamp(min=0).tolist(), ends.T.clamp(min=0).tolist(), strict=True):
        mask[tuple(itertools.starmap(slice, zip(low, end, strict=True)))] = True
    expected = mask.reshape(-1).nonzero()[:, 0]
    assert torch.equal(covered_places_reference(lows, ends, shape), expected)
    assert torch.equal(under("numba", covered_places, lows, ends, shape), expected)


@pytest.mark.usefixtures("backend")
def test_many_boxes_over_one_place_are_counted_right():
    lows, ends = torch.zeros(3, 70_000, dtype=torch.int64), torch.ones(3, 70_000, dtype=torch.int64)
    assert covered_places(lows, ends, (1, 2, 3)).tolist() == [0]


@pytest.mark.parametrize(
    ("shape", "dtype", "raster", "message"),
    [
        ((3, 4), torch.int64, (2, 2), "shape must be of three sizes"),
        ((2, 4), torch.int64, (2, 2, 2), r"ends must have shape \(3, 4\), got \(2, 4\)"),
        ((3, 4), torch.float32, (2, 2, 2), "must be int64, got torch.int64 and torch.float32"),
    ],
)
def test_what_does_not_fit_is_refused(shape, dtype, raster, message):
    with pytest.raises(ValueError, match=message):
        covered_places(torch.zeros(3, 4, dtype=torch.int64), torch.zeros(shape, dtype=dtype), raster)
