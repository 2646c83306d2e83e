import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dnerf import kernels
from dnerf.kernels import covered_places
from dnerf.kernels.covered_places import covered_places_reference


def random_boxes(shape, count, reach, seed):
    """Boxes that begin anywhere, also beside the raster, up to `reach` long; some hold nothing."""
    generator = torch.Generator().manual_seed(seed)
    lows = torch.stack([torch.randint(-3, size + 4, (count,), generator=generator) for size in shape])
    return lows, lows + torch.randint(-1, reach, lows.shape, generator=generator)


@settings(max_examples=60, deadline=None)
@given(
    shape=st.lists(st.integers(0, 12), min_size=1, max_size=3),
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
    with kernels.use_backend("numba"):
        assert torch.equal(covered_places(lows, ends, shape), expected)


def test_many_boxes_over_one_place_are_counted_right():
    lows, ends = torch.zeros(2, 70_000, dtype=torch.int64), torch.ones(2, 70_000, dtype=torch.int64)
    for backend in ("numba", "reference"):
        with kernels.use_backend(backend):
            assert covered_places(lows, ends, (2, 3)).tolist() == [0]


def test_what_does_not_fit_is_refused():
    boxes = torch.zeros(2, 4, dtype=torch.int64)
    with pytest.raises(ValueError, match="shape must be of 1 to 3 sizes"):
        covered_places(boxes, boxes, (2, 2, 2, 2))
    with pytest.raises(ValueError, match=r"lows must be \(3, M\)"):
        covered_places(boxes, boxes, (2, 2, 2))
    with pytest.raises(ValueError, match="ends must be"):
        covered_places(boxes, boxes.float(), (2, 2))
    with pytest.raises(ValueError, match="as many boxes, got 4 and 3"):
        covered_places(boxes, boxes[:, 1:], (2, 2))
