import itertools
import math
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.backends import under

from dnerf import kernels
from dnerf.kernels import GridLevels, grid_encode
from dnerf.kernels.grid_encode import grid_encode_reference

# Dense, hashed and anisotropic levels.
LEVELS = GridLevels((3, (5, 2, 7), 16), max_rows=256)
PLANES = GridLevels(((5, 2, 0), (3, 3, 3), (9, 7, 0)), max_rows=256)


def example(num_samples, levels=LEVELS, num_features=3, dtype=torch.float64, seed=0):
    """Positions around and outside the unit cube, also exactly on its faces, and a random table."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(num_samples, 3, generator=generator, dtype=dtype) * 1.5 - 0.25
    positions[::7, 0], positions[1::7, 1], positions[2::7, 2] = 1.0, 0.0, 0.5
    table = torch.randn(levels.num_rows, num_features, generator=generator, dtype=dtype)
    return positions, table


def loop_encode(positions, table, levels):
    """Interpolation vertex by vertex, in plain Python."""
    out = []
    for position in positions.tolist():
        features = []
        for level, resolution in enumerate(levels.resolutions):
            total = [0.0] * table.shape[1]
            scaled = [min(max(p, 0.0), 1.0) * r for p, r in zip(position, resolution)]
            lower = [min(math.floor(s), r - 1) for s, r in zip(scaled, resolution)]
            for corner in itertools.product((0, 1), repeat=3):
                weight = math.prod(s - b if c else 1 - (s - b) for s, b, c in zip(scaled, lower, corner))
                x, y, z = (b + c for b, c in zip(lower, corner))
                if math.prod(r + 1 for r in resolution) > levels.max_rows:
                    row = (x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % levels.max_rows
                else:
                    row = x + (resolution[0] + 1) * (y + (resolution[1] + 1) * z)
                values = table[levels.offsets[level] + row].tolist()
                total = [t + weight * v for t, v in zip(total, values)]
            features += total
        out.append(features)
    return torch.tensor(out, dtype=table.dtype)


def values_and_gradients(positions, table, levels, grad):
    positions, table = positions.clone().requires_grad_(), table.clone().requires_grad_()
    out = grid_encode(positions, table, levels)
    return out.detach(), *torch.autograd.grad(out, (positions, table), grad)


def test_levels_describe_the_table():
    assert LEVELS.hashed == (False, False, True)
    assert LEVELS.offsets == (0, 64, 64 + 6 * 3 * 8, 64 + 6 * 3 * 8 + 256)
    assert LEVELS.num_rows == LEVELS.offsets[-1]


@pytest.mark.parametrize(("resolutions", "max_rows"), [((), 8), ((0,), 8), (((2, 2),), 8), ((2,), 12), ((2,), 0)])
def test_impossible_levels_are_refused(resolutions, max_rows):
    with pytest.raises(ValueError, match="got"):
        GridLevels(resolutions, max_rows)


@pytest.mark.parametrize(("axes", "row", "message"), [(2, 0, r"positions .* \(N, 3\), got \(4, 2\)"), (3, 1, "table")])
def test_wrong_shapes_are_refused(axes, row, message):
    positions, table = example(4)
    with pytest.raises(ValueError, match=message):
        grid_encode(positions[:, :axes], table[row:], LEVELS)


def test_reference_equals_loop(reference):
    positions, table = example(60)
    torch.testing.assert_close(grid_encode(positions, table, LEVELS), loop_encode(positions, table, LEVELS))


def test_linear_function_is_reproduced_with_its_slope(compiled):
    levels = GridLevels(((4, 5, 6),), 4096)
    x, y, z = (torch.linspace(0, 1, n + 1, dtype=torch.float64) for n in levels.resolutions[0])
    vertices = torch.stack(torch.meshgrid(z, y, x, indexing="ij"), -1).flip(-1).reshape(-1, 3)
    slopes = torch.tensor([2.0, -3.0, 0.5], dtype=torch.float64, device=compiled)
    positions = torch.rand(50, 3, dtype=torch.float64).to(compiled).requires_grad_()
    out = grid_encode(positions, (vertices.to(compiled) @ slopes)[:, None], levels)
    torch.testing.assert_close(out[:, 0], positions.detach() @ slopes)
    (gradient,) = torch.autograd.grad(out.sum(), positions)
    torch.testing.assert_close(gradient, slopes.expand_as(gradient))


def both(levels, num_samples, num_features=3, dtype=torch.float64, seed=0, device="cpu", backend="numba"):
    """Values and gradients of a compiled version, and those of the reference."""
    positions, table = (x.to(device) for x in example(num_samples, levels, num_features, dtype, seed))
    grad = torch.randn(num_samples, levels.num_levels * num_features, dtype=dtype).to(device)
    return [under(name, values_and_gradients, positions, table, levels, grad) for name in (backend, "reference")]


@settings(max_examples=12, deadline=None)
@given(
    num_samples=st.integers(0, 40),
    num_features=st.sampled_from([3, 8]),
    resolutions=st.lists(st.tuples(*[st.integers(1, 12)] * 3), min_size=1, max_size=3),
    log_rows=st.integers(3, 10),
    seed=st.integers(0, 9),
)
def test_numba_agrees_with_reference_on_random_grids(num_samples, num_features, resolutions, log_rows, seed):
    torch.testing.assert_close(*both(GridLevels(resolutions, 2**log_rows), num_samples, num_features, seed=seed))


def test_a_plane_is_a_bilinear_interpolation_that_no_third_coordinate_moves(compiled):
    levels = GridLevels(((5, 2, 0), (9, 7, 0)), max_rows=256)
    assert levels.num_rows == 6 * 3 + 10 * 8
    positions, table = (x.to(compiled) for x in example(150, levels))
    points = (2 * positions.clamp(0, 1) - 1)[None, None, :, :2]
    planes = [part.T.reshape(1, 3, rows, -1) for part, rows in zip(table.split([18, 80]), (3, 8))]
    expected = torch.cat([torch.nn.functional.grid_sample(x, points, align_corners=True)[0, :, 0] for x in planes]).T
    torch.testing.assert_close(grid_encode(positions, table, levels), expected, rtol=1e-9, atol=1e-9)
    grad = torch.ones(150, 6, dtype=table.dtype, device=table.device)
    _, along, _ = values_and_gradients(positions, table, levels, grad)
    assert not along[:, 2].any()
    assert along[:, :2].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("num_samples", [0, 1, 150])
@pytest.mark.parametrize("grid", [LEVELS, PLANES], ids=["cells", "planes"])
def test_compiled_agrees_with_reference(compiled, grid, dtype, num_samples):
    # Sums of some tens of terms of size one, scaled by up to 16 cells in the gradient to positions.
    tolerance = 2e-5 if dtype == torch.float32 else 1e-12
    found = both(grid, num_samples, dtype=dtype, device=compiled, backend=kernels.get_backend())
    torch.testing.assert_close(*found, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("num_samples", [255, 256, 257, 700])  # of which 256 are located at once
def test_numba_agrees_with_reference_in_blocks_of_places(num_samples):
    levels = GridLevels((3, 40, (3000, 70000, 100000)), max_rows=256)  # products with the hash's primes wrap around
    torch.testing.assert_close(*both(levels, num_samples), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_vertices_show_their_row_to_the_last_bit(compiled, dtype):
    levels = GridLevels((4,), max_rows=256)
    z, y, x = torch.meshgrid(*[torch.linspace(0, 1, 5, dtype=dtype)] * 3, indexing="ij")
    table = 10.0 ** torch.linspace(-8, 8, levels.num_rows, dtype=dtype)[:, None]
    vertices = torch.stack([x, y, z], -1).reshape(-1, 3)
    assert torch.equal(grid_encode(vertices.to(compiled), table.to(compiled), levels).cpu(), table)


def test_gradcheck(compiled):
    levels = GridLevels((1, 2), 8)
    positions, table = example(2, levels, 1)
    # Away from the faces of cells, where the function has kinks.
    positions = (positions.clamp(0.03, 0.97) + 0.017).to(compiled).requires_grad_()
    table = table.to(compiled).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, t: grid_encode(p, t, levels), (positions, table), nondet_tol=1e-12)


def test_positions_outside_are_clamped_and_have_no_gradient_there(compiled):
    _, table = example(1)
    outside = torch.tensor([[-0.5, 0.3, 1.5]], dtype=torch.float64, device=compiled, requires_grad=True)
    clamped = torch.tensor([[0.0, 0.3, 1.0]], dtype=torch.float64, device=compiled)
    out = grid_encode(outside, table.to(compiled), LEVELS)
    torch.testing.assert_close(out, grid_encode(clamped, table.to(compiled), LEVELS))
    (gradient,) = torch.autograd.grad(out.sum(), outside)
    assert (gradient[0] != 0).tolist() == [False, True, False]


def test_nan_position_gives_nan_and_touches_only_its_sample(compiled):
    positions, table = (x.to(compiled) for x in example(3, dtype=torch.float32))
    positions[1] = torch.nan
    out = grid_encode(positions, table, LEVELS)
    assert out.isnan().any(1).tolist() == [False, True, False]


def test_either_gradient_may_be_left_out(compiled):
    arguments = [x.to(compiled) for x in example(4)]
    for i in range(2):
        inputs = [x.clone().requires_grad_(k == i) for k, x in enumerate(arguments)]
        (gradient,) = torch.autograd.grad(grid_encode(*inputs, LEVELS).sum(), inputs[i])
        assert gradient.shape == inputs[i].shape


def test_half_precision_arguments_are_widened():
    positions, table = example(10, dtype=torch.float32)
    positions, table = positions.bfloat16().requires_grad_(), table.half().requires_grad_()
    out = grid_encode(positions, table, LEVELS)
    assert out.dtype == torch.float32
    gradients = torch.autograd.grad(out.sum(), (positions, table))
    assert [g.dtype for g in gradients] == [torch.bfloat16, torch.float16]


def test_table_gradient_does_not_depend_on_threads():
    positions, table = example(2000, dtype=torch.float32)
    grad = torch.randn(2000, 9)
    threads, results = torch.get_num_threads(), []
    try:
        for n in (1, 2, threads):
            torch.set_num_threads(n)
            results.append(under("numba", values_and_gradients, positions, table, LEVELS, grad))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(*pair) for result in results[1:] for pair in zip(result, results[0]))


def test_table_gradient_split_into_row_blocks_is_the_same():
    from dnerf.kernels.cpu import grid_encode as cpu
    from dnerf.kernels.cpu.cells import cell_tables
    from dnerf.kernels.cpu.launch import none_taken

    positions, table = (x.numpy() for x in example(500))
    grad = torch.randn(500, 9, dtype=torch.float64).numpy()
    levels = cpu.levels_of(tuple(LEVELS.cells), LEVELS.max_rows)
    whole, parts = torch.zeros(2, *table.shape, dtype=torch.float64)
    for part_bits, workers, out in ((0, 2, whole), (2, 5, parts)):
        tables = cell_tables(positions.dtype, workers)
        cpu._grad_table(grad, positions, levels, part_bits, out.numpy(), tables, workers, none_taken(), (0,) * 3)
    assert torch.equal(whole, parts)


def test_reference_is_differentiable_twice(reference):
    positions, table = (x.requires_grad_() for x in example(3, GridLevels((2,), 32), 1))
    positions = (positions.detach().clamp(0.03, 0.97) + 0.017).requires_grad_()
    encode = partial(grid_encode_reference, levels=GridLevels((2,), 32))
    assert torch.autograd.gradgradcheck(encode, (positions, table))


def test_second_derivative_of_a_compiled_kernel_is_refused():
    positions, table = example(3)
    positions.requires_grad_()
    with kernels.use_backend("numba"):
        total = (grid_encode(positions, table, LEVELS) ** 2).sum()
        (gradient,) = torch.autograd.grad(total, positions, create_graph=True)
        with pytest.raises(RuntimeError, match=r"grid_encode is differentiable once.*use_backend\(\"reference\"\)"):
            gradient.sum().backward()


@pytest.mark.usefixtures("backend")
def test_rounded_features_are_those_that_are_rounded_after():
    positions, table = example(3000, num_features=8, dtype=torch.float32)
    table[5], table[7] = torch.nan, 3e38
    with torch.no_grad():
        rounded = grid_encode(positions, table, LEVELS, rounded=True)
        exact = grid_encode(positions, table, LEVELS)
    assert rounded.dtype == torch.bfloat16
    assert 0 < int(rounded.isnan().sum()) < rounded.numel() // 10
    assert torch.equal(rounded.isnan(), exact.isnan())
    assert torch.equal(rounded.nan_to_num(), exact.bfloat16().nan_to_num())


def test_nothing_is_rounded_where_gradients_are_recorded_or_in_double_precision():
    positions, table = example(20, dtype=torch.float32)
    assert grid_encode(positions, table, LEVELS, rounded=True).dtype == torch.float32
    with torch.no_grad():
        assert grid_encode(positions.double(), table, LEVELS, rounded=True).dtype == torch.float64


@pytest.mark.usefixtures("backend")
def test_features_half_way_between_two_are_rounded_to_the_even_one():
    levels = GridLevels((2,), 32)
    table = (1 + torch.arange(8) * 2.0**-8).expand(27, 8).contiguous()  # steps of bfloat16 at 1 are 2^-7
    with torch.no_grad():
        rounded = grid_encode(torch.zeros(1, 3), table, levels, rounded=True)
    assert ((rounded[0].float() - 1) * 2**7).tolist() == [0, 0, 1, 2, 2, 2, 3, 4]
