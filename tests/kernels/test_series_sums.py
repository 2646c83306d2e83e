"""Sums of series of density and colour: a loop, compiled versions, gradients, and what is no number."""

import pytest
import torch
from kernels.backends import under
from torch import Tensor

from dnerf.kernels import series_sums

SIZES = ((1, 1), (1, 9), (4, 4), (4, 12), (3, 27))  # terms of density, and of each colour


def parts(of_density: int, terms: int, count: int = 20, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Coefficients and basis functions."""
    generator = torch.Generator().manual_seed(0)
    coefficients = torch.randn(count, of_density + 3 * terms, generator=generator, dtype=torch.float64)
    return coefficients.to(dtype), torch.randn(count, terms, generator=generator, dtype=torch.float64)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize(("of_density", "terms"), SIZES)
def test_sums_equal_loops(of_density: int, terms: int) -> None:
    coefficients, basis = parts(of_density, terms)
    found = series_sums(coefficients, basis).tolist()
    for row, functions, sums in zip(coefficients.tolist(), basis.tolist(), found, strict=True):
        expected = [sum(c * b for c, b in zip(row[:of_density], functions))]
        for start in range(of_density, len(row), terms):
            expected.append(sum(c * b for c, b in zip(row[start : start + terms], functions, strict=True)))
        assert sums == pytest.approx(expected, rel=1e-12, abs=1e-12)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize(("of_density", "terms"), SIZES)
def test_gradcheck(of_density: int, terms: int) -> None:
    coefficients, basis = (x.requires_grad_() for x in parts(of_density, terms, count=3))
    assert torch.autograd.gradcheck(series_sums, (coefficients, basis))


def test_the_definition_is_differentiable_twice() -> None:
    coefficients, basis = (x.requires_grad_() for x in parts(2, 3, count=2))
    assert under("reference", torch.autograd.gradgradcheck, series_sums, (coefficients, basis))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float32])
@pytest.mark.parametrize("count", [0, 1, 255, 600])
def test_compiled_sums_and_gradients_are_those_of_the_definition(dtype: torch.dtype, count: int) -> None:
    def sums_and_gradients() -> tuple[Tensor, ...]:
        coefficients, basis = parts(4, 12, count, dtype)
        arguments = coefficients.requires_grad_(), basis.float().requires_grad_()
        sums = series_sums(*arguments)
        return sums.detach(), *torch.autograd.grad(sums.square().sum(), arguments)

    found, expected = under("numba", sums_and_gradients), under("reference", sums_and_gradients)
    assert [x.dtype for x in found] == [torch.float32, dtype, torch.float32]
    for x, y in zip(found, expected, strict=True):
        # Sums of twelve terms in another order; gradients to short numbers are rounded to them.
        torch.testing.assert_close(x, y, rtol=1e-5 if x.dtype == torch.float32 else 0.01, atol=1e-4)


@pytest.mark.usefixtures("backend")
def test_what_is_no_number_is_seen_in_its_own_sum_alone() -> None:
    coefficients, basis = parts(2, 3, count=4)
    coefficients[1, 0], coefficients[2, 2], coefficients[3, 10] = torch.nan, torch.inf, torch.nan
    is_bad = ~series_sums(coefficients, basis).isfinite()
    assert is_bad.nonzero().tolist() == [[1, 0], [2, 1], [3, 3]]


@pytest.mark.parametrize(("columns", "rows", "message"), [
    (9, 2, r"coefficients must have D \+ 3 K columns, 0 < D <= K = 3, got 9"), (13, 2, "got 13"),
    (12, 3, r"basis must have shape \(2, K\), got \(3, 3\)"),
])  # fmt: skip
def test_wrong_shapes_are_named(columns: int, rows: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        series_sums(torch.zeros(2, columns), torch.zeros(rows, 3))
