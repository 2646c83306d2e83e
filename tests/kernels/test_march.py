import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dnerf import kernels
from dnerf.kernels import MarchGrid, march, skip_distances

BOX = torch.tensor([[-1.0, -0.5, 0.0], [1.0, 0.5, 3.0]])


def rays(num_rays, seed=0, dtype=torch.float32):
    """Rays from outside and inside the box, some along its axes, faces and edges, some that miss it."""
    generator = torch.Generator().manual_seed(seed)
    targets = BOX[0] + torch.rand(num_rays, 3, generator=generator) * (BOX[1] - BOX[0]) * 1.3
    origins = torch.randn(num_rays, 3, generator=generator) * 3
    origins[::5] = targets[::5] * 0.5
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    directions[::7] = torch.tensor([0.0, 1.0, 0.0])
    directions[3::11] = torch.tensor([-1.0, 0.0, 0.0])
    origins[::21] = torch.tensor([1.0, -2.0, 3.0])
    origins[1::13] = BOX[1] - 2 * directions[1::13]
    near = torch.rand(num_rays, generator=generator)
    far = near + torch.rand(num_rays, generator=generator) * 9
    far[2::6] = near[2::6]
    far[4::6] = torch.inf
    scalars = {
        "near": near,
        "far": far,
        "times": torch.linspace(0, 1, max(num_rays, 1))[:num_rays],
        "jitter": torch.rand(num_rays, generator=generator),
    }
    return {k: v.to(dtype) for k, v in ({"origins": origins, "directions": directions} | scalars).items()}


def grid(shape=(3, 16, 9, 24), share=0.1, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < share


def loop_march(origins, directions, near, far, times, jitter, occupancy, aabb, step, limit=None):
    """Every interval of every ray, one by one, rounding to float32 after each operation."""
    f = np.float32
    lower, upper = aabb.numpy()
    slabs, *shape = occupancy.shape
    step, samples = f(step), []
    for r in range(len(near)):
        o, d, t0, t1 = origins[r].numpy(), directions[r].numpy(), near[r].numpy(), far[r].numpy()
        enter, leave = t0, t1
        for a in range(3):
            if d[a] == 0:
                if not lower[a] <= o[a] <= upper[a]:
                    leave = f(-np.inf)
            else:
                faces = (lower[a] - o[a]) / d[a], (upper[a] - o[a]) / d[a]
                enter, leave = max(enter, min(faces)), min(leave, max(faces))
        slab = min(math.floor(times[r].item() * slabs), slabs - 1)
        kept = 0
        k = max(int((enter - t0) / step) - 3, -1) if leave > enter else 0
        while leave > enter:
            start = max(t0 + (f(k) - f(1) + jitter[r].numpy()) * step, enter)
            end = min(t0 + (f(k) + jitter[r].numpy()) * step, leave)
            k += 1
            if start >= leave or kept == limit:
                break
            if end <= start:
                continue
            cells = (o + d * ((start + end) * f(0.5)) - lower) * (np.array(shape, f) / (upper - lower))
            x, y, z = (min(max(math.floor(c), 0), n - 1) for c, n in zip(cells, shape))
            if occupancy[slab, x, y, z]:
                samples.append((start, end, r))
                kept += 1
    starts, ends, indices = (list(x) for x in zip(*samples)) if samples else ([], [], [])
    counts = np.bincount(np.array(indices, dtype=np.int64), minlength=len(near))
    return (
        torch.from_numpy(np.array(starts, np.float32)),
        torch.from_numpy(np.array(ends, np.float32)),
        torch.tensor(indices, dtype=torch.int64),
        torch.tensor([0, *counts.cumsum()], dtype=torch.int64),
    )


def assert_same(actual, expected):
    for a, b in zip(actual, expected, strict=True):
        assert a.dtype == b.dtype
        assert torch.equal(a.cpu(), b.cpu())


@pytest.mark.parametrize("limit", [None, 3])
def test_reference_equals_loop(reference, limit):
    arguments = rays(120)
    actual = march(**arguments, occupancy=grid(), aabb=BOX, step=0.07, max_samples_per_ray=limit)
    assert len(actual.starts) > 50
    assert_same(actual, loop_march(**arguments, occupancy=grid(), aabb=BOX, step=0.07, limit=limit))


@settings(max_examples=50, deadline=None)
@given(
    num_rays=st.integers(0, 80),
    shape=st.tuples(st.integers(1, 3), *[st.integers(1, 50)] * 3),
    share=st.sampled_from([0.0, 0.001, 0.02, 0.5, 1.0]),
    step=st.sampled_from([0.003, 0.05, 0.4, 20.0]),
    limit=st.sampled_from([None, 1, 5]),
    seed=st.integers(0, 99),
    part=st.tuples(*[st.tuples(st.integers(0, 49), st.integers(1, 50))] * 3),
)
def test_skipping_changes_no_bit(num_rays, shape, share, step, limit, seed, part):
    occupancy, inside = grid(shape, share, seed), torch.zeros(shape, dtype=torch.bool)
    inside[(slice(None), *(slice(first, first + size) for first, size in part))] = True
    arguments = rays(num_rays, seed) | {"occupancy": occupancy & inside, "aabb": BOX, "step": step}
    with kernels.use_backend("reference"):
        expected = march(**arguments, max_samples_per_ray=limit)
    with kernels.use_backend("numba"):
        assert_same(march(**arguments, max_samples_per_ray=limit), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("limit", [None, 2])
def test_compiled_equals_reference(compiled, dtype, limit):
    arguments = {k: v.to(compiled) for k, v in rays(40, dtype=dtype).items()}
    arguments |= {"occupancy": grid().to(compiled), "aabb": BOX.to(compiled), "step": 0.07}
    actual = march(**arguments, max_samples_per_ray=limit)
    with kernels.use_backend("reference"):
        assert_same(actual, march(**arguments, max_samples_per_ray=limit))


def test_precomputed_skips_change_nothing():
    arguments = rays(200) | {"occupancy": grid(share=0.001), "aabb": BOX, "step": 0.01}
    assert_same(march(**arguments, skips=skip_distances(arguments["occupancy"])), march(**arguments))


def test_distant_and_nearly_parallel_rays_skip_exactly():
    arguments = rays(400, seed=3)
    arguments["origins"] -= 300 * arguments["directions"]
    directions = arguments["directions"]
    directions[::2, 1] = torch.where(directions[::2, 1].abs() < 0.9, 1e-6, directions[::2, 1])
    arguments["far"] += 600
    occupancy = grid((3, 40, 40, 40), 0.01)
    occupancy[1, 20:] = False
    occupancy[2, :, :30, 8:] = False
    arguments |= {"occupancy": occupancy, "aabb": BOX, "step": 0.01}
    with kernels.use_backend("reference"):
        expected = march(**arguments)
    assert len(expected.starts) > 100
    with kernels.use_backend("numba"):
        assert_same(march(**arguments), expected)


def test_full_grid_is_covered_from_entry_to_exit(compiled):
    origins = torch.tensor([[-3.0, 0.0, 1.0]], device=compiled)
    ones = torch.ones(1, device=compiled)
    result = march(
        origins,
        torch.tensor([[1.0, 0.0, 0.0]], device=compiled),
        0 * ones,
        10 * ones,
        times=ones,
        jitter=0.25 * ones,
        occupancy=torch.ones(2, 4, 4, 4, dtype=torch.bool, device=compiled),
        aabb=BOX.to(compiled),
        step=0.3,
    )
    assert result.starts[0] == 2
    assert result.ends[-1] == 4
    assert torch.equal(result.starts[1:], result.ends[:-1])
    torch.testing.assert_close(result.ends[1:-1] - result.starts[1:-1], torch.full((6,), 0.3, device=compiled))
    torch.testing.assert_close(result.ends[0] % 0.3, 0.075 * ones[0])


def test_only_the_slab_of_the_time_is_read(compiled):
    occupancy = torch.zeros(4, 2, 2, 2, dtype=torch.bool, device=compiled)
    occupancy[3] = True
    times = torch.tensor([0.0, 0.7499, 0.75, 1.0], device=compiled)
    result = march(
        torch.tensor([[-3.0, 0.1, 1.0]], device=compiled).expand(4, 3),
        torch.tensor([[1.0, 0.0, 0.0]], device=compiled).expand(4, 3),
        torch.zeros(4, device=compiled),
        torch.full((4,), 10.0, device=compiled),
        times=times,
        jitter=torch.zeros(4, device=compiled),
        occupancy=occupancy,
        aabb=BOX.to(compiled),
        step=0.5,
    )
    assert result.offsets.tolist() == [0, 0, 0, 4, 8]


@pytest.mark.parametrize("num_rays", [0, 6])
def test_no_samples_give_empty_tensors(compiled, num_rays):
    arguments = {k: v.to(compiled) for k, v in rays(num_rays).items()}
    occupancy = torch.zeros(1, 4, 4, 4, dtype=torch.bool, device=compiled)
    result = march(**arguments, occupancy=occupancy, aabb=BOX.to(compiled), step=0.1)
    assert [len(x) for x in result] == [0, 0, 0, num_rays + 1]
    assert result.ray_indices.dtype == result.offsets.dtype == torch.int64


def test_rays_that_are_not_finite_get_no_samples(compiled):
    arguments = {k: v.to(compiled) for k, v in rays(4).items()}
    arguments["origins"][0, 1] = torch.nan
    arguments["directions"][1, 2] = torch.nan
    arguments["near"][2] = torch.nan
    arguments["far"][3] = torch.nan
    occupancy = torch.ones(1, 4, 4, 4, dtype=torch.bool, device=compiled)
    result = march(**arguments, occupancy=occupancy, aabb=BOX.to(compiled), step=0.1)
    assert len(result.starts) == 0
    # Also where the ray does not move along the axis on which it is not finite.
    arguments = {k: v.to(compiled) for k, v in rays(4).items()}
    arguments["origins"] = torch.tensor([[torch.nan, 0.0, -3.0]], device=compiled).expand(4, 3).contiguous()
    arguments["directions"] = torch.tensor([[0.0, 0.0, 1.0]], device=compiled).expand(4, 3).contiguous()
    result = march(**arguments, occupancy=occupancy, aabb=BOX.to(compiled), step=0.1)
    assert len(result.starts) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"near": torch.zeros(4, 1)}, r"near must have shape \(4,\), got \(4, 1\)"),
        ({"directions": torch.zeros(3, 3)}, r"directions must have shape \(4, 3\)"),
        ({"occupancy": torch.zeros(4, 4, 4, dtype=torch.bool)}, "occupancy must be bool"),
        ({"aabb": torch.zeros(6)}, r"aabb must have shape \(2, 3\)"),
        ({"step": 0.0}, "step must be positive"),
        ({"max_samples_per_ray": 0}, "max_samples_per_ray must be at least 1"),
        ({"skips": torch.zeros(1, 1, 1, 1, dtype=torch.uint8)}, "skips must have shape"),
    ],
)
def test_wrong_arguments_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        march(**rays(4) | {"occupancy": grid(), "aabb": BOX, "step": 0.1} | change)


@pytest.mark.parametrize("share", [0.0005, 0.002, 0.5])
def test_all_intervals_lie_in_the_grids_extent(share):
    occupancy = grid((1, 40, 9, 24), share, seed=2)
    found = MarchGrid(occupancy[0], skip_distances(occupancy)[0], BOX, 0.05).extent()
    bundle = rays(3000, seed=4)
    kept = march(**bundle, occupancy=occupancy, aabb=BOX, step=0.05)
    o, d = (bundle[name][kept.ray_indices] for name in ("origins", "directions"))
    assert len(o)
    for distances in (kept.starts, kept.ends):
        places = o + distances[:, None] * d
        assert ((places >= found[0] - 1e-5) & (places <= found[1] + 1e-5)).all()
    assert share > 0.0005 or ((found[1] - found[0]) < 0.9 * (BOX[1] - BOX[0])).any()


def test_extent_of_nothing_is_small():
    empty = grid(share=0.0)
    found = MarchGrid(empty[0], skip_distances(empty)[0], BOX, 0.05).extent()
    torch.testing.assert_close(found[1] - found[0], torch.full((3,), 0.05))


def test_opcheck():
    arguments = rays(6)
    order = ("origins", "directions", "near", "far", "times", "jitter")
    torch.library.opcheck(torch.ops.dnerf.march.default, (*(arguments[k] for k in order), grid(), BOX, 0.1, None, None))


def test_compiles_without_graph_breaks():
    arguments = rays(30) | {"occupancy": grid(), "aabb": BOX}
    with torch._dynamo.config.patch(capture_dynamic_output_shape_ops=True):
        lengths = torch.compile(
            lambda **k: (lambda s: s.ends - s.starts)(march(**k, step=0.1)),
            fullgraph=True,
            backend="aot_eager",
        )
        actual = lengths(**arguments)
    samples = march(**arguments, step=0.1)
    assert torch.equal(actual, samples.ends - samples.starts)


def test_rays_may_require_gradients(compiled):
    arguments = {k: v.to(compiled) for k, v in rays(20).items()}
    constants = {"occupancy": grid().to(compiled), "aabb": BOX.to(compiled), "step": 0.1}
    expected = march(**arguments, **constants)
    arguments["origins"].requires_grad_()
    result = march(**arguments, **constants)
    assert_same(result, expected)
    assert not result.starts.requires_grad
