import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.backends import under

from dnerf.kernels import MarchGrid, march, march_to_size, skip_distances
from dnerf.kernels.march_to_size import fitted

STEP = torch.tensor(0.07)
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


def march_on(device, bundle, occupancy, step, **options):
    """Through the box, on a device."""
    bundle = {name: value.to(device) for name, value in bundle.items()}
    return march(**bundle, occupancy=occupancy.to(device), aabb=BOX.to(device), step=step, **options)


def parallel(origin, direction, times, jitter=0.0):
    """Rays from one point in one direction, of several times."""
    count, times = len(times), torch.tensor(times)
    pose = {
        "origins": torch.tensor([origin]).expand(count, 3),
        "directions": torch.tensor([direction]).expand(count, 3),
    }
    return pose | {"near": 0 * times, "far": 0 * times + 10, "times": times, "jitter": 0 * times + jitter}


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
    expected = under("reference", march, **arguments, max_samples_per_ray=limit)
    assert_same(under("numba", march, **arguments, max_samples_per_ray=limit), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("limit", [None, 2])
def test_compiled_equals_reference(compiled, dtype, limit):
    arguments = compiled, rays(40, dtype=dtype), grid(), 0.07
    actual = march_on(*arguments, max_samples_per_ray=limit)
    assert_same(actual, under("reference", march_on, *arguments, max_samples_per_ray=limit))


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
    expected = under("reference", march, **arguments)
    assert len(expected.starts) > 100
    assert_same(under("numba", march, **arguments), expected)


def test_full_grid_is_covered_from_entry_to_exit(compiled):
    bundle = parallel([-3.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0], jitter=0.25)
    result = march_on(compiled, bundle, torch.ones(2, 4, 4, 4, dtype=torch.bool), 0.3)
    assert (result.starts[0], result.ends[-1]) == (2, 4)
    assert torch.equal(result.starts[1:], result.ends[:-1])
    torch.testing.assert_close((result.ends[1:-1] - result.starts[1:-1]).cpu(), torch.full((6,), 0.3))
    torch.testing.assert_close((result.ends[0] % 0.3).cpu(), torch.tensor(0.075))


def test_only_the_slab_of_the_time_is_read(compiled):
    occupancy = torch.zeros(4, 2, 2, 2, dtype=torch.bool)
    occupancy[3] = True
    bundle = parallel([-3.0, 0.1, 1.0], [1.0, 0.0, 0.0], [0.0, 0.7499, 0.75, 1.0])
    assert march_on(compiled, bundle, occupancy, 0.5).offsets.tolist() == [0, 0, 0, 4, 8]


@pytest.mark.parametrize("num_rays", [0, 6])
def test_no_samples_give_empty_tensors(compiled, num_rays):
    result = march_on(compiled, rays(num_rays), torch.zeros(1, 4, 4, 4, dtype=torch.bool), 0.1)
    assert [len(x) for x in result] == [0, 0, 0, num_rays + 1]
    assert result.ray_indices.dtype == result.offsets.dtype == torch.int64


def test_rays_that_are_not_finite_get_no_samples(compiled):
    full, broken = torch.ones(1, 4, 4, 4, dtype=torch.bool), rays(4)
    broken["origins"][0, 1] = broken["directions"][1, 2] = broken["near"][2] = broken["far"][3] = torch.nan
    assert not len(march_on(compiled, broken, full, 0.1).starts)
    # Also where the ray does not move along the axis on which it is not finite.
    still = parallel([torch.nan, 0.0, -3.0], [0.0, 0.0, 1.0], [0.5])
    assert not len(march_on(compiled, still, full, 0.1).starts)


@pytest.mark.parametrize(("change", "message"), [
    ({"near": torch.zeros(4, 1)}, r"near must have shape \(4,\), got \(4, 1\)"),
    ({"directions": torch.zeros(3, 3)}, r"directions must have shape \(4, 3\)"),
    ({"occupancy": torch.zeros(4, 4, 4, dtype=torch.bool)}, "occupancy must be bool of shape"),
    ({"aabb": torch.zeros(6)}, r"aabb must have shape \(2, 3\)"),
    ({"step": 0.0}, "step must be > 0"),
    ({"max_samples_per_ray": 0}, "max_samples_per_ray must be > 0"),
    ({"skips": torch.zeros(1, 1, 1, 1, dtype=torch.uint8)}, "skips must have shape"),
])  # fmt: skip
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


def test_rays_may_require_gradients(compiled):
    bundle = rays(20)
    expected = march_on(compiled, bundle, grid(), 0.1)
    bundle["origins"].requires_grad_()
    result = march_on(compiled, bundle, grid(), 0.1)
    assert_same(result, expected)
    assert not result.starts.requires_grad


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1, 20, 60, 500])
def test_compiled_march_to_size_equals_its_definition(compiled, size, dtype):
    """All fit, some rays do not, none does."""
    arguments = rays(120, dtype=dtype) | {"occupancy": grid(), "aabb": BOX.to(dtype)}
    marched = under("reference", march, **arguments, step=float(STEP.to(dtype)))
    expected, wanted = fitted(marched, size)
    moved = {name: value.to(compiled) for name, value in arguments.items()}
    actual, found = march_to_size(**moved, step=STEP.to(compiled, dtype), size=size)
    assert_same(actual, expected)
    assert int(found) == int(wanted) == len(marched.starts) > 60
    is_real = expected.ends > expected.starts
    assert is_real.sum() == len(marched.starts) if size == 500 else is_real.sum() <= size


@given(seed=st.integers(0, 99), share=st.sampled_from([0.0, 0.01, 0.3]), size=st.integers(1, 300))
def test_what_fits_is_what_is_marched(seed, share, size):
    arguments = rays(50, seed) | {"occupancy": grid(share=share, seed=seed), "aabb": BOX}
    marched = march(**arguments, step=0.07)
    actual, wanted = march_to_size(**arguments, step=STEP, size=size)
    assert int(wanted) == len(marched.starts)
    last = int((marched.offsets <= size).sum()) - 1  # rays that fit
    is_real = actual.ends > actual.starts
    for name in ("starts", "ends", "ray_indices"):
        assert torch.equal(getattr(actual, name)[is_real], getattr(marched, name)[: marched.offsets[last]])
    assert int(actual.offsets[-1]) == size == len(actual.starts)


@pytest.mark.parametrize(("changes", "message"), [
    ({"size": 0}, "rays and places for samples, got 30 and 0"),
    (rays(0), "got 0 and 10"),
    ({"step": torch.ones(1)}, "step must be a scalar"),
    ({"near": torch.zeros(3)}, "near must have shape"),
])  # fmt: skip
def test_wrong_arguments_of_march_to_size_are_refused(changes, message):
    arguments = rays(30) | {"occupancy": grid(), "aabb": BOX, "step": STEP, "size": 10} | changes
    with pytest.raises(ValueError, match=message):
        march_to_size(**arguments)
