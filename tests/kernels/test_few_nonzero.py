"""The few true entries of a mask are found as `nonzero` finds them."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernels.backends import under

from dnerf.kernels import few_nonzero


@given(st.lists(st.integers(0, 9), max_size=3), st.sampled_from([0.0, 0.05, 0.7, 1.0]), st.integers(0, 99))
def test_it_equals_nonzero(shape: list[int], share: float, seed: int) -> None:
    mask = torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < share
    for backend in ("numba", "reference"):
        assert torch.equal(under(backend, few_nonzero, mask), mask.reshape(-1).nonzero()[:, 0])


def test_views_may_begin_anywhere_and_skip() -> None:
    mask = torch.rand(7, 9, 11, generator=torch.Generator().manual_seed(0)) < 0.2
    for view in (mask[1:], mask[:, 1:], mask.mT, mask.view(-1)[3:], mask[..., ::2], mask.view(-1)[5:6].expand(20)):
        assert torch.equal(few_nonzero(view), view.reshape(-1).nonzero()[:, 0])


def test_what_is_no_mask_is_refused() -> None:
    with pytest.raises(ValueError, match=r"mask must be bool, got torch\.uint8"):
        few_nonzero(torch.zeros(3, dtype=torch.uint8))
