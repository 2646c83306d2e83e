"""Rays and samples: layouts, positions and the errors of shapes that do not fit."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference import rays_towards_origin
from torch import Tensor

from dnerf.core.rays import Rays, Samples


def ragged() -> tuple[Samples, Tensor]:
    """Packed samples of five rays with 2, 0, 3, 1, 0 samples, and their rays' indices."""
    indices = torch.tensor([0, 0, 2, 2, 2, 3])
    starts = torch.tensor([1.0, 2.0, 1.0, 1.5, 4.0, 3.0])
    return Samples(starts, starts + 0.5, 5, ray_indices=indices), indices


def test_offsets_tell_where_each_ray_begins_and_ends() -> None:
    samples, indices = ragged()
    assert samples.is_packed
    assert samples.offsets.tolist() == [0, 2, 2, 5, 6, 6]
    for r in range(5):
        assert (indices[samples.offsets[r] : samples.offsets[r + 1]] == r).all()


def test_given_offsets_are_used() -> None:
    offsets = torch.tensor([0, 1, 2])
    samples = Samples(torch.zeros(2), torch.ones(2), 2, ray_indices=torch.tensor([0, 1]), ray_offsets=offsets)
    assert samples.offsets is offsets


def test_offsets_of_an_empty_batch_are_zero() -> None:
    empty = Samples(torch.empty(0), torch.empty(0), 3, ray_indices=torch.empty(0, dtype=torch.int64))
    assert empty.offsets.tolist() == [0, 0, 0, 0]


def test_dense_samples_have_no_offsets() -> None:
    samples = Samples(torch.zeros(2, 3), torch.ones(2, 3), 2)
    with pytest.raises(ValueError, match="must be packed"):
        _ = samples.offsets


@pytest.mark.parametrize("trailing", [(), (3,), (2, 2)])
def test_each_sample_gets_its_rays_value(trailing: tuple[int, ...]) -> None:
    values = torch.rand(5, *trailing)
    packed, indices = ragged()
    given = packed.per_sample(values)
    assert given.shape == (6, *trailing)
    for i, r in enumerate(indices.tolist()):
        assert torch.equal(given[i], values[r])
    dense = Samples(torch.zeros(5, 4), torch.ones(5, 4), 5).per_sample(values)
    assert dense.shape == (5, 4, *trailing)
    assert all(torch.equal(dense[:, s], values) for s in range(4))


def test_positions_lie_along_the_rays() -> None:
    rays = rays_towards_origin(5, torch.float64)
    starts = torch.rand(5, 4, dtype=torch.float64).sort(-1).values
    points = starts + 0.125
    dense = Samples(starts, starts + 0.5, 5, points=points)
    for samples, distances in ((dense, points), (Samples(starts, starts + 0.5, 5), starts + 0.25)):
        positions = samples.locate(rays)[0]
        for r in range(5):
            for s in range(4):
                expected = rays.origins[r] + distances[r, s] * rays.directions[r]
                torch.testing.assert_close(positions[r, s], expected, rtol=1e-14, atol=1e-15)
        torch.testing.assert_close(samples.packed().locate(rays)[0], positions.flatten(0, 1), rtol=0, atol=0)


def test_packing_keeps_what_the_mask_holds() -> None:
    starts = torch.arange(6.0).reshape(2, 3)
    dense = Samples(starts, starts + 1, 2, points=starts + 0.25)
    mask = torch.tensor([[True, False, True], [False, False, True]])
    packed = dense.packed(mask)
    assert packed.starts.tolist() == [0, 2, 5]
    assert packed.ends.tolist() == [1, 3, 6]
    assert packed.distances.tolist() == [0.25, 2.25, 5.25]
    assert packed.ray_indices is not None
    assert packed.ray_indices.tolist() == [0, 0, 1]
    assert packed.lengths.tolist() == [1, 1, 1]
    assert dense.packed().ray_indices.tolist() == [0, 0, 0, 1, 1, 1]  # type: ignore[union-attr]


def test_packed_samples_are_not_packed_again() -> None:
    with pytest.raises(ValueError, match="must be dense"):
        ragged()[0].packed()


def test_packed_samples_are_chosen_from_ray_by_ray() -> None:
    starts = torch.arange(5.0)
    packed = Samples(starts, starts + 1, 4, ray_indices=torch.tensor([0, 0, 2, 2, 3]), points=starts + 0.25)
    kept = packed.kept(torch.tensor([False, True, False, True, False]))
    assert kept.starts.tolist() == [1, 3]
    assert kept.distances.tolist() == [1.25, 3.25]
    assert kept.offsets.tolist() == [0, 1, 1, 2, 2]
    assert replace(kept, ray_offsets=None).offsets.tolist() == kept.offsets.tolist()
    none = packed.kept(torch.zeros(5, dtype=torch.bool))
    assert none.offsets.tolist() == [0] * 5
    last = packed.chosen(torch.tensor([0, 4]))
    assert last.ends.tolist() == [1, 5]
    assert last.ray_indices is not None
    assert last.ray_indices.tolist() == [0, 3]
    assert last.offsets.tolist() == [0, 1, 1, 1, 2]


def test_opaque_samples_stay_opaque_when_they_are_chosen_split_or_fitted() -> None:
    packed = Samples(torch.zeros(2), torch.ones(2), 2, ray_indices=torch.tensor([0, 1]), is_opaque=True)
    none = replace(packed, is_opaque=False)
    for samples, expected in ((packed, True), (none, False)):
        made = (samples.kept(torch.ones(2, dtype=torch.bool)), samples.chosen(torch.tensor([1])), samples.padded(4))
        for other in (*made, samples.split(2), samples.fitted(torch.tensor([1, 2]), 4)[0]):
            assert other.is_opaque is expected


@given(st.integers(1, 5))
def test_split_intervals_fill_what_they_were_cut_from(count: int) -> None:
    starts = torch.tensor([0.0, 1.0, 5.0])
    packed = Samples(starts, starts + torch.tensor([1.0, 0.5, 0.0]), 3, ray_indices=torch.tensor([0, 0, 2]))
    split = packed.split(count)
    assert torch.equal(split.starts[::count], packed.starts)
    assert torch.equal(split.ends[count - 1 :: count], packed.ends)
    torch.testing.assert_close(split.lengths, packed.lengths.repeat_interleave(count) / count, rtol=0, atol=1e-6)
    parts = split.starts.reshape(3, count), split.ends.reshape(3, count)
    assert torch.equal(parts[0][:, 1:], parts[1][:, :-1])
    assert split.offsets.tolist() == [0, 2 * count, 2 * count, 3 * count]
    assert torch.equal(split.offsets, replace(split, ray_offsets=None).offsets)


def test_each_interval_can_have_its_own_number_of_parts() -> None:
    starts = torch.tensor([0.0, 1.0, 5.0])
    packed = Samples(starts, starts + torch.tensor([1.0, 0.5, 3.0]), 4, ray_indices=torch.tensor([0, 0, 2]))
    split = packed.split(torch.tensor([1, 2, 3]))
    assert split.starts.tolist() == [0, 1, 1.25, 5, 6, 7]
    assert split.ends.tolist() == [1, 1.25, 1.5, 6, 7, 8]
    assert split.ray_indices is not None
    assert split.ray_indices.tolist() == [0, 0, 0, 2, 2, 2]
    assert split.offsets.tolist() == [0, 3, 3, 6, 6]
    none = packed.kept(torch.zeros(3, dtype=torch.bool))
    assert none.split(torch.zeros(0, dtype=torch.int64)).offsets.tolist() == [0] * 5
    for wrong, message in ((torch.tensor([1, 0, 2]), "least 1, got 0"), (torch.ones(2), "must have shape"), (0, "0")):
        with pytest.raises(ValueError, match=message):
            packed.split(wrong)


def test_bounds_follow_their_samples() -> None:
    starts = torch.tensor([[0.0, 1.0], [2.0, 4.0]])
    dense = Samples(starts, starts + 1, 2, bounds=(starts + 10, starts + 20))
    packed = dense.packed(starts != 1)
    for samples, first in (
        (packed, [0, 2, 4]), (packed.padded(4), [0, 2, 4, 4]), (packed.split(2), [0, 0, 2, 2, 4, 4]),
    ):  # fmt: skip
        assert [(bound - 10 * k).tolist() for k, bound in enumerate(samples.bounds, 1)] == [first, first]
    assert packed.kept(torch.ones(3, dtype=torch.bool)).bounds == ()
    with pytest.raises(ValueError, match="bounds must have shape"):
        replace(packed, bounds=(starts,))


def test_dense_samples_are_neither_chosen_from_nor_split() -> None:
    dense = Samples(torch.zeros(2, 3), torch.ones(2, 3), 2)
    with pytest.raises(ValueError, match="must be packed to be chosen from"):
        dense.kept(torch.ones_like(dense.starts, dtype=torch.bool))
    with pytest.raises(ValueError, match="must be packed"):
        dense.split(2)


def test_rays_are_sliced_masked_and_cast_together() -> None:
    rays = rays_towards_origin(10)
    assert len(rays) == 10
    part = rays[torch.arange(10) % 2 == 1]
    assert len(part) == 5
    assert torch.equal(part.times, rays.times[1::2])
    assert torch.equal(rays[3:5].origins, rays.origins[3:5])
    double = rays.to(torch.float64)
    assert {x.dtype for x in (double.origins, double.directions, double.times, double.near, double.far)} == {
        torch.float64
    }
    assert len(rays[:0]) == 0


def make_rays(**shapes: tuple[int, ...]) -> Rays:
    defaults: dict[str, tuple[int, ...]] = {
        "origins": (4, 3), "directions": (4, 3), "times": (4,), "near": (4,), "far": (4,),
    }  # fmt: skip
    return Rays(**{name: torch.zeros(shape) for name, shape in {**defaults, **shapes}.items()})


@pytest.mark.parametrize(("call", "message"), [
    (lambda: make_rays(times=(4, 1)), "times must have shape (4,), got (4, 1)"),
    (lambda: make_rays(times=()), "times must have shape (4,), got ()"),
    (lambda: make_rays(origins=(4,)), "origins must have shape (R, 3), got (4,)"),
    (lambda: make_rays(origins=()), "origins must have shape (R, 3), got ()"),
    (lambda: make_rays(directions=(5, 3)), "directions must have shape (4, 3), got (5, 3)"),
    (lambda: make_rays(far=(5,)), "far must have shape (4,), got (5,)"),
    (lambda: Samples(torch.zeros(2, 3), torch.zeros(2, 4), 2), "ends must have shape (2, 3), got (2, 4)"),
    (lambda: Samples(torch.zeros(2, 3), torch.zeros(2, 3), 4), "starts must have shape (4, S), got (2, 3)"),
    (
        lambda: Samples(torch.zeros(6), torch.zeros(6), 2, ray_indices=torch.zeros(5, dtype=torch.int64)),
        "ray_indices must have shape (6,), got (5,)",
    ),
    (
        lambda: Samples(torch.zeros(2, 3), torch.zeros(2, 3), 2, points=torch.zeros(2)),
        "points must have shape (2, 3), got (2,)",
    ),
    (
        lambda: Samples(
            torch.zeros(1), torch.ones(1), 2, ray_indices=torch.tensor([0]), ray_offsets=torch.tensor([0, 1])
        ),
        "ray_offsets must have shape (3,), got (2,)",
    ),
    (
        lambda: Samples(torch.zeros(2, 3), torch.zeros(2, 3), 2).packed(torch.ones(2, 2, dtype=torch.bool)),
        "mask must have shape (2, 3), got (2, 2)",
    ),
])  # fmt: skip
def test_shapes_that_do_not_fit_are_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError) as error:
        call()
    assert str(error.value) == message
