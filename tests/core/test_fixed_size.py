"""Fixed numbers of places: what fits is there once, in order, and what does not fit is left out ray by ray."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dnerf.core.fixed_size import fit, placed, spread
from dnerf.core.rays import Samples

COUNTS = st.lists(st.lists(st.integers(0, 3), max_size=6), min_size=1, max_size=8)


@given(wanted=st.lists(st.integers(0, 9), min_size=1, max_size=12), size=st.integers(1, 60))
def test_places_are_dealt_out_in_order(wanted: list[int], size: int) -> None:
    filled, offsets = (x.tolist() for x in spread(torch.tensor(wanted), size))
    total = 0
    for want, got in zip(wanted, filled, strict=True):
        total += want
        assert got == (want if total <= size else 0)
    assert offsets[0] == 0
    assert offsets[-1] == size
    extra = [b - a - got for a, b, got in zip(offsets[:-1], offsets[1:], filled, strict=True)]
    assert min(extra) >= 0
    assert max(extra) - min(extra) <= 1


@given(counts=COUNTS, size=st.integers(1, 40))
def test_every_sample_that_fits_takes_as_many_places_as_it_wants(counts: list[list[int]], size: int) -> None:
    flat = [c for ray in counts for c in ray]
    if not flat:
        flat, counts = [0], [[0], *counts[1:]]
    offsets = torch.tensor([0, *(len(ray) for ray in counts)]).cumsum(0)
    chosen = fit(offsets, torch.tensor(flat), size)
    expected, number, total = [], 0, 0
    for ray, parts in enumerate(counts):
        total += sum(parts)
        for count in parts:
            expected += [(ray, number, part) for part in range(count)] if total <= size else []
            number += 1
    real = chosen.is_filled.nonzero()[:, 0].tolist()
    assert [(int(chosen.rays[i]), int(chosen.source[i]), int(chosen.part[i])) for i in real] == expected
    assert int(chosen.wanted) == sum(flat)
    assert chosen.rays.tolist() == sorted(chosen.rays.tolist())
    for ray in range(len(counts)):
        assert (chosen.rays[chosen.offsets[ray] : chosen.offsets[ray + 1]] == ray).all()


def some_samples() -> Samples:
    starts = torch.tensor([1.0, 1.5, 2.5, 1.0, 3.0, 3.5])
    lengths = torch.tensor([0.5, 0.5, 0.25, 1.0, 0.5, 0.5])
    return Samples(starts, starts + lengths, 4, ray_indices=torch.tensor([0, 0, 0, 2, 3, 3]))


def test_fitted_samples_are_those_that_are_kept_and_split() -> None:
    samples, counts = some_samples(), torch.tensor([0, 2, 1, 3, 0, 1])
    fitted, wanted = samples.fitted(counts, 11)
    expected = samples.kept(counts > 0).split(counts[counts > 0])
    is_real = fitted.lengths > 0
    assert int(wanted) == 7 == int(is_real.sum())
    assert torch.equal(fitted.starts[is_real], expected.starts)
    assert torch.equal(fitted.ends[is_real], expected.ends)
    assert fitted.ray_indices is not None
    assert torch.equal(fitted.ray_indices[is_real], expected.ray_indices)
    assert torch.equal(fitted.starts[~is_real], torch.zeros(4))
    assert fitted.offsets.tolist() == [0, 4, 5, 9, 11]  # 3, 0, 3 and 1, and a place more each


def test_rays_that_do_not_fit_get_nothing() -> None:
    fitted, wanted = some_samples().fitted(torch.full((6,), 2), 9)
    assert int(wanted) == 12
    assert fitted.ray_indices is not None
    assert fitted.ray_indices[fitted.lengths > 0].tolist() == [0] * 6 + [2] * 2


@pytest.mark.parametrize(
    "samples",
    [
        Samples(torch.zeros(2, 3), torch.ones(2, 3), 2),
        Samples(torch.zeros(0), torch.zeros(0), 2, ray_indices=torch.zeros(0, dtype=torch.int64)),
    ],
    ids=["dense", "none"],
)
def test_what_cannot_be_fitted_is_refused(samples: Samples) -> None:
    with pytest.raises(ValueError, match="must be packed, some"):
        samples.fitted(torch.ones_like(samples.starts, dtype=torch.int64), 4)


@given(wanted=st.lists(st.integers(0, 9), min_size=1, max_size=12), size=st.integers(1, 60))
def test_rays_are_placed_unless_their_places_lacked(wanted: list[int], size: int) -> None:
    """All of them if there is room; else none behind the last that got any: whether those wanted some is not known."""
    counts = torch.tensor(wanted)
    offsets = torch.arange(len(wanted) + 1)
    chosen = fit(offsets, counts, size)
    found = placed(chosen.rays, chosen.is_filled, len(wanted), chosen.wanted).tolist()
    ends = counts.cumsum(0).tolist()
    if ends[-1] <= size:
        assert all(found)
        return
    for want, end, is_placed in zip(wanted, ends, found, strict=True):
        if want:
            assert is_placed == (end <= size)
        elif end > size:
            assert not is_placed
    assert found == sorted(found, reverse=True)
