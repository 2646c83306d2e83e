"""Which intervals are seen, and the parts into which they are cut."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.backends import under
from torch import Tensor

from dnerf import kernels
from dnerf.kernels import SeenParts, packed_weights, seen_parts
from dnerf.kernels.seen_parts import seen_parts_reference

OPTIONS = {"subdivision": 3, "subdivision_weight": 0.02, "min_weight": 4e-3}


def intervals(counts: list[int], seed: int = 0, dtype: torch.dtype = torch.float32) -> tuple[Tensor, ...]:
    """Starts, ends, offsets, densities and light of rays with so many intervals each."""
    g = torch.Generator().manual_seed(seed)
    offsets = torch.tensor([0, *counts]).cumsum(0)
    size = int(offsets[-1])
    starts = torch.cat([torch.arange(n) * 0.03 + 2 for n in counts]) if size else torch.zeros(0)
    density = torch.exp(4 * torch.randn(size, generator=g))
    light = torch.rand(len(counts), generator=g)
    return tuple(x.to(dtype) if x.is_floating_point() else x for x in (starts, starts + 0.03, offsets, density, light))


def weights_of(arguments: tuple[Tensor, ...]) -> Tensor:
    starts, ends, offsets, density, light = arguments
    return packed_weights(density * (ends - starts), offsets) * light.repeat_interleave(offsets.diff())


@settings(max_examples=60, deadline=None)
@given(
    counts=st.lists(st.integers(0, 40), max_size=8), subdivision=st.integers(1, 4),
    subdivision_weight=st.sampled_from([0.0, 0.02, 0.3]), least=st.sampled_from([1e-12, 4e-3]),
    is_double=st.booleans(), seed=st.integers(0, 9),
)  # fmt: skip
def test_numba_equals_the_definition(
    counts: list[int], subdivision: int, subdivision_weight: float, least: float, is_double: bool, seed: int
) -> None:
    arguments = intervals(counts, seed, torch.float64 if is_double else torch.float32)
    weights = weights_of(arguments)
    for limit in (subdivision_weight, least):  # what rounding could decide
        near = (weights - limit).abs() <= 1e-6 * limit
        arguments[3][near] *= 1.01
    options = {"subdivision": subdivision, "subdivision_weight": subdivision_weight, "min_weight": least}
    found = under("numba", seen_parts, *arguments, **options)
    expected = seen_parts_reference(*arguments, **options)
    for a, b, name in zip(found, expected, SeenParts._fields, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-6 if a.is_floating_point() else 0, msg=name)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("subdivision", [2, 3])
def test_parts_fill_their_intervals_and_only_new_middles_are_named(subdivision: int) -> None:
    arguments = intervals([0, 20, 1, 40, 0], dtype=torch.float64)
    starts, ends = arguments[:2]
    weights = weights_of(arguments)
    parts = seen_parts(*arguments, **OPTIONS | {"subdivision": subdivision})
    number = parts.whole.bincount(minlength=len(starts))
    assert torch.equal(number == 0, weights <= 4e-3)
    assert torch.equal(number == 1, (weights > 4e-3) & (weights <= 0.02))
    assert torch.equal(number == subdivision, weights > 0.02)
    assert min(int((number == k).sum()) for k in (0, 1, subdivision)) > 0
    lengths = torch.zeros_like(starts).index_add(0, parts.whole, parts.ends - parts.starts)
    torch.testing.assert_close(lengths[number > 0], (ends - starts)[number > 0])
    first = torch.cat([parts.whole.new_tensor([True], dtype=torch.bool), parts.whole.diff() > 0])
    assert torch.equal(parts.starts[first], starts[number > 0])  # exactly
    assert torch.equal(parts.ends[first.roll(-1)], ends[number > 0])
    middles = 0.5 * (parts.starts + parts.ends)
    is_known = (middles - 0.5 * (starts + ends)[parts.whole]).abs() < 1e-9
    assert torch.equal(parts.new, (~is_known).nonzero()[:, 0])
    assert torch.equal(parts.ray_indices, torch.arange(5).repeat_interleave(parts.offsets.diff()))


@pytest.mark.usefixtures("backend")
def test_what_is_no_number_is_seen() -> None:
    starts, ends, offsets, density, light = intervals([3, 3])
    density[:] = 0
    density[1], density[4] = torch.nan, torch.inf
    ends[4] = starts[4]  # where infinite density adds nothing
    parts = seen_parts(starts, ends, offsets, density, light, **OPTIONS)
    assert parts.whole.tolist() == [1, 1, 1, 2, 2, 2]  # and all behind it, on its ray


@pytest.mark.usefixtures("backend")
def test_nothing_is_seen_behind_what_is_opaque() -> None:
    starts, ends, offsets, *_ = intervals([4])
    density, options = torch.tensor([1.0, torch.inf, 1.0, 1.0]), {"subdivision": 1, "subdivision_weight": 0.0}
    parts = seen_parts(starts, ends, offsets, density, torch.ones(1), **options, min_weight=0.0)
    assert parts.whole.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"subdivision": 0}, "subdivision must be > 0 and finite, got 0"),
        ({"light": torch.ones(1)}, r"light must have shape \(2,\), got \(1,\)"),
        ({"density": torch.ones(3)}, r"density must have shape \(4,\), got \(3,\)"),
        ({"offsets": torch.tensor([0, 2, 5])}, "offsets must run from 0 to 4, got 0 to 5"),
    ],
)
def test_wrong_arguments_are_named(change: dict, message: str) -> None:
    arguments = dict(zip(("starts", "ends", "offsets", "density", "light"), intervals([2, 2]), strict=True))
    with kernels.use_backend("numba"), pytest.raises(ValueError, match=message):
        seen_parts(**arguments | OPTIONS | change)
