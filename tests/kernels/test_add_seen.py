"""Compositing rounds of packed samples into what rays have shown."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.backends import under
from kernels.test_seen_parts import intervals
from torch import Tensor

from dnerf import kernels
from dnerf.core.compositing import FieldOutput, composite
from dnerf.core.rays import Samples
from dnerf.kernels import add_seen
from dnerf.kernels.add_seen import add_seen_reference


def rounds(counts: list[int], seed: int = 0, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """Arguments for rays with so many samples each, in rows of a larger table that are not in order."""
    starts, _, offsets, density, light = intervals(counts, seed)
    g = torch.Generator().manual_seed(seed)
    arguments = {
        "sums": torch.rand(len(counts) + 3, 5, generator=g),
        "rays": torch.randperm(len(counts) + 3, generator=g)[: len(counts)],
        "ends": starts + 0.03 * torch.rand(len(starts), generator=g),
        "rgb": torch.rand(len(starts), 3, generator=g),
        **{"light": light, "starts": starts, "offsets": offsets, "density": density},
    }
    return {k: x.to(dtype) if x.is_floating_point() else x for k, x in arguments.items()}


def added(backend: str, arguments: dict[str, Tensor], distances: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """What the sums become, and what passes."""
    sums = arguments["sums"].clone()
    passing = under(backend, add_seen, **(arguments | {"sums": sums}), distances=distances)
    return sums, passing


@settings(max_examples=60, deadline=None)
@given(counts=st.lists(st.integers(0, 40), max_size=100), has_distances=st.booleans(), seed=st.integers(0, 9))
def test_numba_equals_the_definition(counts: list[int], has_distances: bool, seed: int) -> None:
    arguments = rounds(counts, seed)
    distances = 0.9 * arguments["starts"] if has_distances else None
    sums = arguments["sums"].double()
    exact = {k: x.double() if x.is_floating_point() else x for k, x in arguments.items()} | {"sums": sums}
    passing = add_seen_reference(**exact, distances=None if distances is None else distances.double())
    found = added("numba", arguments, distances)
    torch.testing.assert_close(found, (sums.float(), passing.float()), rtol=0, atol=3e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rounds_add_up_to_one_image(backend: str, dtype: torch.dtype) -> None:
    count, first = 12, 5
    a = rounds([count] * 20, dtype=dtype)
    samples = Samples(a["starts"], a["ends"], 20, ray_indices=torch.arange(20).repeat_interleave(count))
    whole = composite(samples, FieldOutput(a["density"], a["rgb"]))
    sums, light = torch.zeros(20, 5, dtype=dtype), torch.ones(20, dtype=dtype)
    for part in (slice(first), slice(first, None)):
        names = ("starts", "ends", "density", "rgb")
        of_part = {k: a[k].unflatten(0, (20, count))[:, part].flatten(0, 1) for k in names}
        offsets = torch.arange(21) * (len(of_part["starts"]) // 20)
        with kernels.use_backend(backend):
            light = light * add_seen(sums, torch.arange(20), light, offsets=offsets, **of_part)
    expected = torch.cat([whole.rgb, (whole.depth * whole.opacity)[:, None], whole.opacity[:, None]], dim=-1)
    torch.testing.assert_close(sums, expected, rtol=0, atol=2e-6)
    torch.testing.assert_close(light, 1 - whole.opacity, rtol=0, atol=2e-6)


def test_hard_densities(backend: str) -> None:
    """Nothing passes what is opaque, nothing is added of what is empty, NaN is seen; other rays and rows stay."""
    a = rounds([2, 2, 2, 2, 2])
    a["density"] = torch.tensor([torch.inf, 5, 0, 0, torch.nan, 1, 1e30, 1e30, 1, torch.inf])
    a["ends"][9] = a["starts"][9]
    sums, passing = added(backend, a)
    first, second, third, fourth, last = (sums[row] - a["sums"][row] for row in a["rays"].tolist())
    torch.testing.assert_close(first[:3], a["light"][0] * a["rgb"][0])
    assert passing[[0, 3]].tolist() == [0, 0]
    assert passing[1] == 1
    torch.testing.assert_close(fourth[4], a["light"][3])
    assert not second.any()
    assert third.isnan().all()
    assert passing[2].isnan()
    opacity = -torch.expm1(a["starts"][8] - a["ends"][8])  # of the first sample alone: the other one has no length
    torch.testing.assert_close(last[4], a["light"][4] * opacity)
    others = torch.ones(len(sums), dtype=torch.bool).index_fill_(0, a["rays"], False)
    assert torch.equal(sums[others], a["sums"][others])


@pytest.mark.parametrize(("name", "wrong", "message"), [
    *((name, slice(1, None), f"{name} must have shape") for name in ("light", "density", "ends", "offsets")),
    *((name, (slice(None), slice(2)), f"{name} must have shape") for name in ("sums", "rgb")),
    ("offsets", torch.tensor([0, 2, 5]), "offsets must run from 0 to 4, got 0 to 5"),
    ("rays", torch.tensor([1, 5]), r"rays must lie in \[0, 5\), got 1 to 5"),
    ("distances", torch.zeros(3), "distances must have shape"),
])  # fmt: skip
def test_wrong_arguments_are_named(name: str, wrong: object, message: str) -> None:
    a = rounds([2, 2])
    value = wrong if isinstance(wrong, Tensor) else a[name][wrong]
    with kernels.use_backend("numba"), pytest.raises(ValueError, match=message):
        add_seen(**a | {name: value})
