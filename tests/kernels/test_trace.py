import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dnerf import kernels
from dnerf.kernels import FrameTables, brick_lookup, grid_encode, march, skip_distances, trace
from dnerf.kernels.brick_lookup import BRICK, VERTICES
from dnerf.kernels.grid_encode import GridLevels

BOX = torch.tensor([[-1.0, -0.5, 0.0], [1.0, 0.5, 1.5]])
PER_UNIT = 12.0
OPTIONS = {"step": 0.05, "splits": 1, "min_weight": 0.0, "split_weight": 0.0}
OPTIONS |= {"cells_per_unit": PER_UNIT, "log_shift": 1.0}


def tables(seed=0, known=1.0, bricks=1.0, share=0.3, num_terms=3, reach=0.15, cells=(5, 4, 6), adds=False):
    """A scene in which shares of the vertices and bricks exist, and whose lattice may add to what bricks hold."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(shape, generator=generator)

    is_known = rand(cells[2] + 1, cells[1] + 1, cells[0] + 1) < known
    displacements = torch.where(is_known.reshape(-1, 1), (rand(is_known.numel(), 4) - 0.5) * 2 * reach, torch.nan)
    if adds:
        displacements = torch.cat([displacements, torch.randn(len(displacements), 4, generator=generator)], dim=-1)
    shape = [int(-(-s // BRICK)) for s in ((BOX[1] - BOX[0]) + 0.4) * PER_UNIT]
    slots = torch.full(shape, -1)
    chosen = (rand(slots.numel()) < bricks).nonzero()[:, 0]
    slots.view(-1)[chosen] = torch.arange(len(chosen))
    occupancy = rand(16, 9, 12) < share
    return FrameTables(
        occupancy=occupancy,
        skips=skip_distances(occupancy[None])[0],
        aabb=BOX,
        displacements=displacements,
        is_known=is_known,
        low=BOX[0],
        sides=BOX[1] - BOX[0],
        slots=slots,
        bricks=(torch.randn(len(chosen), VERTICES, 4 * num_terms, generator=generator) * 2).half(),
        brick_low=BOX[0] - 0.2,
        waves=torch.randn(num_terms, generator=generator),
    )


def rays(count, seed=0):
    """Rays through the box, some that miss it, begin inside, or have no length."""
    generator = torch.Generator().manual_seed(seed)
    targets = BOX[0] + torch.rand(count, 3, generator=generator) * (BOX[1] - BOX[0]) * 1.2
    origins = torch.randn(count, 3, generator=generator) * 2
    origins[::7] = targets[::7] * 0.4
    near = torch.rand(count, generator=generator)
    far = near + torch.rand(count, generator=generator) * 8
    far[3::11] = near[3::11]
    return origins, torch.nn.functional.normalize(targets - origins, dim=-1), near, far


def fresh(count):
    states = torch.zeros(count, 5)
    states[:, 0] = 1
    return states, torch.zeros(count, dtype=torch.int64)


def chain(bundle, scene, *, step, cells_per_unit, log_shift, splits, min_weight, split_weight):
    """The same light by march, grid_encode and brick_lookup, added up ray by ray in float64."""
    origins, directions, near, _ = bundle
    zeros = torch.zeros_like(near)
    samples = march(
        *bundle, times=zeros, jitter=zeros, occupancy=scene.occupancy[None], aabb=scene.aabb, step=step
    )  # fmt: skip
    cells = [size - 1 for size in reversed(scene.is_known.shape)]
    levels = GridLevels([cells], 1 << (scene.is_known.numel() - 1).bit_length())

    def look(numbers, distances):
        points = origins[numbers] + distances[:, None] * directions[numbers]
        kept = grid_encode((points - scene.low) / scene.sides, scene.displacements, levels)
        displaced = points + kept[:, :3]
        values, found = brick_lookup((displaced - scene.brick_low) * cells_per_unit, scene.slots, scene.bricks)
        assert found.all()
        terms = values.double().unflatten(-1, (4, -1)) @ scene.waves.double()
        if kept.shape[1] > 4:
            terms += kept[:, 4:].double()
        return torch.exp((terms[:, 0] + log_shift).clamp(max=15)), torch.sigmoid(terms[:, 1:])

    states = fresh(len(near))[0].double()
    middles = (0.5 * (samples.starts + samples.ends),)
    coarse = look(samples.ray_indices, *middles)
    middles += coarse
    lengths = (samples.ends - samples.starts) / splits
    parts = []
    for k in range(splits):
        distances = samples.starts + (k + 0.5) * lengths
        parts.append((distances, *look(samples.ray_indices, distances)))
    for i, r in enumerate(samples.ray_indices.tolist()):
        weight = states[r, 0] * -torch.expm1(-coarse[0][i] * lengths[i] * splits)
        if splits > 1 and weight <= min_weight:
            continue
        is_whole = splits > 1 and weight <= split_weight
        for distances, density, rgb in [middles] if is_whole else parts:
            opacity = -torch.expm1(-density[i] * lengths[i] * (splits if is_whole else 1))
            states[r, 1:4] += states[r, 0] * opacity * rgb[i]
            states[r, 4] += states[r, 0] * opacity * distances[i]
            states[r, 0] *= 1 - opacity
    return states.float()


@pytest.mark.parametrize("backend", ["reference", "numba"])
@pytest.mark.parametrize(
    ("splits", "min_weight", "split_weight"),
    [(1, 0.0, 0.0), (1, 0.1, 0.5), (3, 0.0, 0.0), (2, 0.05, 0.0), (3, 0.01, 0.2), (3, 0.2, 0.1)],
)
@pytest.mark.parametrize("adds", [False, True])
def test_it_is_the_chain_of_its_parts(backend, splits, min_weight, split_weight, adds):
    bundle, scene = rays(150), tables(adds=adds)
    options = OPTIONS | {"splits": splits, "min_weight": min_weight, "split_weight": split_weight}
    with kernels.use_backend(backend):
        states, numbers, vertices, bricks = trace(*bundle, *fresh(150), scene, **options, stop_transmittance=0.0)
    assert (numbers == -1).all()
    assert not vertices.any()
    assert not bricks.any()
    assert (states[:, 0] < 0.5).sum() >= 20
    torch.testing.assert_close(states, chain(bundle, scene, **options), rtol=0, atol=2e-5)


@settings(max_examples=30, deadline=None)
@given(
    count=st.integers(0, 80),
    known=st.sampled_from([0.0, 0.8, 0.97, 1.0]),
    bricks=st.sampled_from([0.0, 0.7, 1.0]),
    reach=st.sampled_from([0.0, 0.1, 0.6]),
    splits=st.integers(1, 4),
    min_weight=st.sampled_from([0.0, 0.01]),
    split_weight=st.sampled_from([0.0, 0.1]),
    stop=st.sampled_from([0.0, 0.1]),
    contents=st.sampled_from(  # each compiles anew
        [(1, torch.float16, False), (2, torch.float32, True), (3, torch.float16, True)]
    ),
    seed=st.integers(0, 99),
)
def test_numba_equals_reference(count, known, bricks, reach, splits, min_weight, split_weight, stop, contents, seed):
    bundle, (num_terms, dtype, adds) = rays(count, seed), contents
    scene = tables(seed, known=known, bricks=bricks, reach=reach, num_terms=num_terms, adds=adds)
    scene = FrameTables(**vars(scene) | {"bricks": scene.bricks.to(dtype)})
    options = OPTIONS | {"splits": splits, "min_weight": min_weight, "split_weight": split_weight}
    found = {}
    for backend in ("reference", "numba"):
        with kernels.use_backend(backend):
            found[backend] = trace(*bundle, *fresh(count), scene, **options, stop_transmittance=stop)
    states, numbers, vertices, wanted = found["numba"]
    expected = found["reference"]
    assert torch.equal(numbers, expected[1])
    assert torch.equal(vertices, expected[2])
    assert torch.equal(wanted, expected[3])
    torch.testing.assert_close(states, expected[0], rtol=0, atol=2e-5)


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_what_waits_goes_on_to_the_same_picture(backend):
    """Filling what is wanted, round by round, ends with the picture of a scene that was known from the start."""
    bundle, whole = rays(100), tables(reach=0.1)
    options = OPTIONS | {"splits": 2, "min_weight": 1e-3, "stop_transmittance": 1e-3}
    with kernels.use_backend(backend):
        expected = trace(*bundle, *fresh(100), whole, **options)[0]
        is_known, slots = torch.zeros_like(whole.is_known), torch.full_like(whole.slots, -1)
        states, numbers = fresh(100)
        for _ in range(200):
            displacements = torch.where(is_known.reshape(-1, 1), whole.displacements, torch.nan)
            part = FrameTables(**vars(whole) | {"displacements": displacements, "is_known": is_known, "slots": slots})
            states, numbers, vertices, bricks = trace(*bundle, states, numbers, part, **options)
            if not vertices.any() and not bricks.any():
                break
            is_known, slots = is_known | vertices.view_as(is_known), torch.where(bricks, whole.slots, slots)
    assert (numbers == -1).all()
    assert is_known.any()
    assert not is_known.all()
    torch.testing.assert_close(states, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_rays_that_leave_the_lattices_say_so_and_nan_is_not_hidden(backend):
    bundle, scene = rays(60), tables(reach=0.0)
    away = torch.full_like(scene.displacements, 50.0)
    nan = torch.full_like(scene.bricks, torch.nan)
    with kernels.use_backend(backend):
        _, far, _, _ = trace(
            *bundle, *fresh(60), FrameTables(**vars(scene) | {"displacements": away}), **OPTIONS, stop_transmittance=0.0
        )
        states, _, _, _ = trace(
            *bundle, *fresh(60), FrameTables(**vars(scene) | {"bricks": nan}), **OPTIONS, stop_transmittance=0.0
        )
        kept = trace(*bundle, fresh(60)[0], torch.full((60,), -2), scene, **OPTIONS, stop_transmittance=0.0)
    assert (far == -2).sum() > 20
    assert states.isnan().any()
    assert torch.equal(kept[0], fresh(60)[0])
    assert (kept[1] == -2).all()


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_bricks_behind_opaque_matter_are_not_wanted(backend):
    scene = tables(bricks=1.0, reach=0.0, share=1.0)
    origins, directions = torch.tensor([[-3.0, 0.0, 0.7]]), torch.tensor([[1.0, 0.0, 0.0]])
    bundle = origins, directions, torch.zeros(1), torch.full((1,), 9.0)
    slots, bricks = scene.slots.clone(), torch.zeros_like(scene.bricks)
    slots[1:] = -1  # all but the first that the ray meets
    bricks[..., 0] = 40 * scene.waves[0].sign()
    for opaque in (True, False):
        part = FrameTables(**vars(scene) | {"slots": slots, "bricks": bricks if opaque else -bricks})
        with kernels.use_backend(backend):
            _, numbers, _, wanted = trace(*bundle, *fresh(1), part, **OPTIONS, stop_transmittance=1e-3)
        assert wanted.sum() == (0 if opaque else 1)
        assert (numbers == -1).item() is opaque


@pytest.mark.parametrize("adds", [False, True])
def test_op_is_registered_properly(adds):
    bundle, scene = rays(10), tables(adds=adds)
    states, numbers = fresh(10)
    scalars = [0.05, 1e-3, 0.05, PER_UNIT, 1.0, 1e-3]
    torch.library.opcheck(torch.ops.dnerf.trace, (numbers, [*bundle, states], scene.tensors(), 2, scalars))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"bricks": torch.zeros(1, VERTICES, 7)}, "bricks must have shape"),
        ({"displacements": torch.zeros(3, 4)}, r"displacements must have shape \(210, 4\)"),
        ({"displacements": torch.zeros(3, 8)}, r"displacements must have shape \(210, 8\)"),
        ({"displacements": torch.zeros(210, 7)}, r"displacements must have shape \(210, 4\)"),
        ({"occupancy": torch.zeros(4, 4, 4)}, "occupancy must be bool of three axes"),
        ({"slots": torch.zeros(2, 2, 2)}, "slots must be int64"),
        ({"skips": torch.zeros(1, 1, 1)}, "skips must have shape"),
        ({"is_known": torch.zeros(1, 4, 4, dtype=torch.bool)}, "is_known must be bool of three axes of at least 2"),
        ({"slots": torch.zeros(0, 2, 2, dtype=torch.int64)}, "slots must be int64"),
        ({"waves": torch.zeros(3, dtype=torch.float64)}, "waves must be float32"),
        ({"bricks": torch.zeros(1, VERTICES, 12).bfloat16()}, "bricks must be float32 or float16"),
    ],
)
def test_wrong_tables_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        FrameTables(**vars(tables()) | wrong)


def test_wrong_rays_are_refused():
    origins, directions, near, far = rays(4)
    with pytest.raises(ValueError, match=r"near must have shape \(4,\)"):
        trace(origins, directions, near[:3], far, *fresh(4), tables(), **OPTIONS, stop_transmittance=0.0)
    for name in ("step", "splits"):
        with pytest.raises(ValueError, match=f"{name} must be positive"):
            trace(
                origins, directions, near, far, *fresh(4), tables(), **OPTIONS | {name: 0}, stop_transmittance=0.0
            )  # fmt: skip
    with pytest.raises(ValueError, match=r"states must have shape \(4, 5\)"):
        trace(origins, directions, near, far, *fresh(3), tables(), **OPTIONS, stop_transmittance=0.0)
