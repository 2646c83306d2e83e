import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dnerf import kernels
from dnerf.kernels import GridLevels, grid_encode
from dnerf.kernels.grid_encode import grid_encode_reference

# Dense, hashed and anisotropic levels.
LEVELS = GridLevels((3, (5, 2, 7), 16), max_rows=256)


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


def test_wrong_shapes_are_refused():
    positions, table = example(4)
    with pytest.raises(ValueError, match=r"positions must have shape \(N, 3\), got \(4, 2\)"):
        grid_encode(positions[:, :2], table, LEVELS)
    with pytest.raises(ValueError, match="table must have shape"):
        grid_encode(positions, table[1:], LEVELS)


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


@settings(max_examples=12, deadline=None)
@given(
    num_samples=st.integers(0, 40),
    num_features=st.sampled_from([1, 3, 8]),
    resolutions=st.lists(st.tuples(*[st.integers(1, 12)] * 3), min_size=1, max_size=3),
    log_rows=st.integers(3, 10),
    seed=st.integers(0, 9),
)
def test_numba_agrees_with_reference_on_random_grids(num_samples, num_features, resolutions, log_rows, seed):
    levels = GridLevels(resolutions, 2**log_rows)
    positions, table = example(num_samples, levels, num_features, seed=seed)
    grad = torch.randn(num_samples, len(resolutions) * num_features, dtype=torch.float64)
    with kernels.use_backend("reference"):
        expected = values_and_gradients(positions, table, levels, grad)
    with kernels.use_backend("numba"):
        actual = values_and_gradients(positions, table, levels, grad)
    torch.testing.assert_close(actual, expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("num_samples", [0, 1, 150])
def test_compiled_agrees_with_reference(compiled, dtype, num_samples):
    positions, table = (x.to(compiled) for x in example(num_samples, dtype=dtype))
    grad = torch.randn(num_samples, 9, dtype=dtype).to(compiled)
    actual = values_and_gradients(positions, table, LEVELS, grad)
    with kernels.use_backend("reference"):
        expected = values_and_gradients(positions, table, LEVELS, grad)
    # Sums of some tens of terms of size one, scaled by up to 16 cells in the gradient to positions.
    tolerance = 2e-5 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("num_samples", [255, 256, 257, 700])  # of which 256 are located at once
def test_numba_agrees_with_reference_in_blocks_of_places(num_samples):
    levels = GridLevels((3, 40, (3000, 70000, 100000)), max_rows=256)  # products with the hash's primes wrap around
    positions, table = example(num_samples, levels)
    grad = torch.randn(num_samples, 9, dtype=torch.float64)
    with kernels.use_backend("reference"):
        expected = values_and_gradients(positions, table, levels, grad)
    with kernels.use_backend("numba"):
        actual = values_and_gradients(positions, table, levels, grad)
    torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-9)


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
    assert gradient[0, 0] == 0
    assert gradient[0, 1] != 0
    assert gradient[0, 2] == 0


def test_nan_position_gives_nan_and_touches_only_its_sample(compiled):
    positions, table = (x.to(compiled) for x in example(3, dtype=torch.float32))
    positions[1] = torch.nan
    out = grid_encode(positions, table, LEVELS)
    assert out.isnan().any(1).tolist() == [False, True, False]


def test_only_the_needed_gradient_is_computed(compiled):
    positions, table = (x.to(compiled) for x in example(4))
    out = grid_encode(positions, table.requires_grad_(), LEVELS)
    (gradient,) = torch.autograd.grad(out.sum(), table)
    assert gradient.shape == table.shape
    out = grid_encode(positions.requires_grad_(), table.detach(), LEVELS)
    (gradient,) = torch.autograd.grad(out.sum(), positions)
    assert gradient.shape == positions.shape


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
    threads = torch.get_num_threads()
    results = []
    try:
        for n in (1, 2, threads):
            torch.set_num_threads(n)
            with kernels.use_backend("numba"):
                results.append(values_and_gradients(positions, table, LEVELS, grad))
    finally:
        torch.set_num_threads(threads)
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0]))


def test_table_gradient_split_into_row_blocks_is_the_same():
    from dnerf.kernels.cpu import grid_encode as cpu
    from dnerf.kernels.cpu.cells import cell_tables
    from dnerf.kernels.cpu.tasks import none_taken

    positions, table = (x.numpy() for x in example(500))
    grad = torch.randn(500, 9, dtype=torch.float64).numpy()
    levels = cpu.levels_of(tuple(LEVELS.cells), LEVELS.max_rows)
    whole, parts = (
        torch.zeros(table.shape, dtype=torch.float64),
        torch.zeros(table.shape, dtype=torch.float64),
    )
    for part_bits, workers, out in ((0, 2, whole), (2, 5, parts)):
        tables = cell_tables(positions.dtype, workers)
        cpu._grad_table(grad, positions, levels, part_bits, out.numpy(), tables, workers, none_taken(), (0,) * 3)
    assert torch.equal(whole, parts)


def test_opcheck(compiled):
    positions, table = (x.to(compiled).requires_grad_() for x in example(6))
    arguments = (positions, table, LEVELS.cells, LEVELS.max_rows)
    torch.library.opcheck(torch.ops.dnerf.grid_encode.default, arguments)
    arguments = (torch.ones(6, 9, dtype=torch.float64, device=compiled), *(a.detach() for a in arguments[:2]))
    for op in (torch.ops.dnerf.grid_encode_grad_table, torch.ops.dnerf.grid_encode_grad_positions):
        torch.library.opcheck(op.default, (*arguments, LEVELS.cells, LEVELS.max_rows))


def test_compiles_without_graph_breaks():
    positions, table = (x.requires_grad_() for x in example(20))

    def loss(positions, table):
        return (grid_encode(positions.sin().abs(), table, LEVELS) ** 2).sum()

    compiled_loss = torch.compile(loss, fullgraph=True, backend="aot_eager")
    expected = torch.autograd.grad(loss(positions, table), (positions, table))
    actual = torch.autograd.grad(compiled_loss(positions, table), (positions, table))
    torch.testing.assert_close(actual, expected)


def test_reference_is_differentiable_twice(reference):
    positions, table = (x.requires_grad_() for x in example(3, GridLevels((2,), 32), 1))
    positions = (positions.detach().clamp(0.03, 0.97) + 0.017).requires_grad_()
    assert torch.autograd.gradgradcheck(
        lambda p, t: grid_encode_reference(p, t, GridLevels((2,), 32)), (positions, table)
    )


def test_second_derivative_of_a_compiled_kernel_is_refused():
    positions, table = example(3)
    positions.requires_grad_()
    with kernels.use_backend("numba"):
        (gradient,) = torch.autograd.grad(
            (grid_encode(positions, table, LEVELS) ** 2).sum(), positions, create_graph=True
        )
        with pytest.raises(RuntimeError, match="no autograd formula"):
            gradient.sum().backward()


@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_rounded_features_are_those_that_are_rounded_after(backend):
    positions, table = example(3000, num_features=8, dtype=torch.float32)
    table[5], table[7] = torch.nan, 3e38
    with kernels.use_backend(backend), torch.no_grad():
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


def test_opcheck_of_rounded_features():
    positions, table = example(6, dtype=torch.float32)
    torch.library.opcheck(torch.ops.dnerf.grid_encode_rounded.default, (positions, table, LEVELS.cells, 256))


@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_features_half_way_between_two_are_rounded_to_the_even_one(backend):
    levels = GridLevels((2,), 32)
    table = (1 + torch.arange(8) * 2.0**-8).expand(27, 8).contiguous()  # steps of bfloat16 at 1 are 2^-7
    with kernels.use_backend(backend), torch.no_grad():
        rounded = grid_encode(torch.zeros(1, 3), table, levels, rounded=True)
    assert ((rounded[0].float() - 1) * 2**7).tolist() == [0, 0, 1, 2, 2, 2, 3, 4]
