# mypy: disable-error-code="call-arg,var-annotated"
"""numba versions of `series_sums` and its gradients."""

from typing import Any

from numba import prange
from torch import Tensor

from .launch import BORROWS, FAST, array, kernel, launch, next_task, none_taken, num_threads
from .shade import single

ROWS = 256  # dealt out to threads


def forward(coefficients: Tensor, basis: Tensor) -> Tensor:
    out = basis.new_empty(len(basis), 4)
    launch(_sums, array(coefficients), array(basis), out.numpy(), num_threads(), none_taken())
    return out


def grad_coefficients(grad: Tensor, basis: Tensor, like: Tensor) -> Tensor:
    out = basis.new_empty(like.shape)
    launch(_spread, array(grad), array(basis), out.numpy(), num_threads(), none_taken())
    return out.to(like.dtype)


def grad_basis(grad: Tensor, coefficients: Tensor, terms: int) -> Tensor:
    out = grad.new_zeros(len(grad), terms)
    launch(_gather, array(grad), array(coefficients), out.numpy(), num_threads(), none_taken())
    return out


@kernel(fastmath=FAST, **BORROWS)
def _sums(coefficients: Any, basis: Any, out: Any, workers: int, taken: Any) -> None:
    terms = basis.shape[1]
    of_first = coefficients.shape[1] - 3 * terms
    for _ in prange(workers):
        first = next_task(taken) * ROWS
        while first < len(out):
            for i in range(first, min(first + ROWS, len(out))):
                total = basis[i, 0] * single(coefficients[i, 0])
                for j in range(1, of_first):
                    total += basis[i, j] * single(coefficients[i, j])
                out[i, 0] = total
                red = green = blue = out.dtype.type(0)
                at = of_first
                for j in range(terms):
                    red += basis[i, j] * single(coefficients[i, at + j])
                    green += basis[i, j] * single(coefficients[i, at + terms + j])
                    blue += basis[i, j] * single(coefficients[i, at + 2 * terms + j])
                out[i, 1], out[i, 2], out[i, 3] = red, green, blue
            first = next_task(taken) * ROWS


@kernel(fastmath=FAST, **BORROWS)
def _spread(grad: Any, basis: Any, out: Any, workers: int, taken: Any) -> None:
    terms = basis.shape[1]
    of_first = out.shape[1] - 3 * terms
    for _ in prange(workers):
        first = next_task(taken) * ROWS
        while first < len(out):
            for i in range(first, min(first + ROWS, len(out))):
                for j in range(of_first):
                    out[i, j] = grad[i, 0] * basis[i, j]
                for c in range(3):
                    at = of_first + c * terms
                    for j in range(terms):
                        out[i, at + j] = grad[i, 1 + c] * basis[i, j]
            first = next_task(taken) * ROWS


@kernel(fastmath=FAST, **BORROWS)
def _gather(grad: Any, coefficients: Any, out: Any, workers: int, taken: Any) -> None:
    terms = out.shape[1]
    of_first = coefficients.shape[1] - 3 * terms
    for _ in prange(workers):
        first = next_task(taken) * ROWS
        while first < len(out):
            for i in range(first, min(first + ROWS, len(out))):
                for j in range(of_first):
                    out[i, j] = grad[i, 0] * single(coefficients[i, j])
                for c in range(3):
                    at = of_first + c * terms
                    for j in range(terms):
                        out[i, j] += grad[i, 1 + c] * single(coefficients[i, at + j])
            first = next_task(taken) * ROWS
