import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dnerf import kernels
from dnerf.kernels import GridLevels, brick_lookup, grid_encode
from dnerf.kernels.brick_lookup import BRICK, VERTICES, brick_lookup_reference


def lattice(shape, num_bricks, num_features, dtype=torch.float32, seed=0):
    """Bricks at random places of a lattice, the others missing."""
    generator = torch.Generator().manual_seed(seed)
    slots = torch.full(shape, -1)
    places = torch.randperm(slots.numel(), generator=generator)[:num_bricks]
    slots.view(-1)[places] = torch.randperm(num_bricks, generator=generator)
    return slots, torch.randn(num_bricks, VERTICES, num_features, generator=generator, dtype=dtype)


def places(count, shape, seed=1, dtype=torch.float32):
    """Positions in and a little around a lattice, some of them on faces, edges and corners of cells and bricks."""
    generator = torch.Generator().manual_seed(seed)
    positions = (torch.rand(count, 3, generator=generator, dtype=dtype) * 1.2 - 0.1) * torch.tensor(shape) * BRICK
    rounded = torch.rand(count, 3, generator=generator) < 0.2
    return torch.where(rounded, positions.round(), positions)


def dense(shape, dtype, num_features=3):
    """All bricks of a lattice and the table of the same values as `grid_encode` wants it."""
    cells = [BRICK * s for s in shape]
    generator = torch.Generator().manual_seed(2)
    values = torch.randn([c + 1 for c in cells] + [num_features], generator=generator, dtype=dtype)
    slots = torch.arange(shape[0] * shape[1] * shape[2]).reshape(shape)
    bricks = torch.stack(
        [
            values[x : x + BRICK + 1, y : y + BRICK + 1, z : z + BRICK + 1].reshape(VERTICES, num_features)
            for x in range(0, cells[0], BRICK)
            for y in range(0, cells[1], BRICK)
            for z in range(0, cells[2], BRICK)
        ]
    )
    return slots, bricks, cells, values.permute(2, 1, 0, 3).reshape(-1, num_features)


def test_all_bricks_together_are_a_dense_grid(reference):
    shape = (2, 3, 1)
    slots, bricks, cells, table = dense(shape, torch.float64)
    positions = places(500, shape, dtype=torch.float64)
    inside = ((positions >= 0) & (positions <= torch.tensor(cells))).all(-1)
    values, known = brick_lookup(positions, slots, bricks)
    assert torch.equal(known, inside)
    assert inside.any()
    assert not inside.all()
    expected = grid_encode(positions / torch.tensor(cells), table, GridLevels([cells], 1 << 20))
    torch.testing.assert_close(values[inside], expected[inside], rtol=0, atol=1e-12)
    assert not values[~inside].any()


@settings(max_examples=25, deadline=None)
@given(
    shape=st.tuples(*[st.integers(1, 4)] * 3),
    share=st.floats(0, 1),
    num_features=st.sampled_from([1, 3, 4]),  # each compiles anew
    count=st.integers(0, 200),
    seed=st.integers(0, 99),
)
def test_numba_equals_reference(shape, share, num_features, count, seed):
    slots, bricks = lattice(shape, round(share * shape[0] * shape[1] * shape[2]), num_features, seed=seed)
    positions = places(count, shape, seed)
    with kernels.use_backend("numba"):
        values, known = brick_lookup(positions, slots, bricks)
    expected, expected_known = brick_lookup_reference(positions, slots, bricks)
    assert torch.equal(known, expected_known)
    # A few roundings of sums of eight numbers of size 3.
    torch.testing.assert_close(values, expected, rtol=0, atol=5e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("num_features", [1, 3, 4, 16])
@pytest.mark.parametrize("count", [0, 1, 1000])
def test_compiled_equals_reference(compiled, dtype, num_features, count):
    shape = (3, 1, 2)
    slots, bricks = lattice(shape, 4, num_features, dtype)
    real = torch.promote_types(dtype, torch.float32)
    positions = places(count, shape, dtype=real)
    values, known = brick_lookup(positions.to(compiled), slots.to(compiled), bricks.to(compiled))
    expected, expected_known = brick_lookup_reference(positions, slots, bricks)
    assert torch.equal(known.cpu(), expected_known)
    assert values.dtype == expected.dtype == real
    torch.testing.assert_close(values.cpu(), expected, rtol=0, atol=5e-6 if real == torch.float32 else 1e-13)


def test_what_is_no_place_is_not_known(compiled):
    slots, bricks = lattice((1, 1, 1), 1, 2)
    strange = [[float("nan"), 1, 1], [1, float("inf"), 1], [1, 1, -float("inf")], [-1e-3, 1, 1], [1, 8.001, 1]]
    positions = torch.tensor([*strange, [8.0, 8, 8]])
    for device, look_up in ((compiled, brick_lookup), ("cpu", brick_lookup_reference)):
        values, known = look_up(positions.to(device), slots.to(device), bricks.to(device))
        assert known.tolist() == [False] * len(strange) + [True]
        assert not values[:-1].any()
        assert torch.equal(values[-1].cpu(), bricks[0, -1])


def test_no_bricks_know_nothing(compiled):
    slots, bricks = torch.full((2, 2, 2), -1, device=compiled), torch.zeros(0, VERTICES, 4, device=compiled)
    for look_up in (brick_lookup, brick_lookup_reference):
        values, known = look_up(torch.full((5, 3), 3.0, device=compiled), slots, bricks)
        assert values.shape == (5, 4)
        assert known.shape == (5,)
        assert not known.any()
        assert not values.any()


def test_op_is_registered_properly():
    slots, bricks = lattice((2, 1, 1), 1, 4)
    torch.library.opcheck(torch.ops.dnerf.brick_lookup, (places(20, (2, 1, 1)), slots, bricks))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"positions": torch.zeros(4)}, r"positions must have shape \(N, 3\)"),
        ({"slots": torch.zeros(1, 1, 1)}, "slots must be int64"),
        ({"bricks": torch.zeros(1, 512, 1)}, "bricks must have shape"),
        ({"bricks": torch.zeros(1, VERTICES, 1).bfloat16()}, "bricks must be float16, float32 or float64"),
    ],
)
def test_wrong_shapes_are_refused(wrong, message):
    right = {
        "positions": torch.zeros(4, 3),
        "slots": torch.zeros(1, 1, 1).long(),
        "bricks": torch.zeros(1, VERTICES, 1),
    }
    with pytest.raises(ValueError, match=message):
        brick_lookup(**right | wrong)
