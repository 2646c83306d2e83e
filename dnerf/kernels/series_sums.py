"""Density and colour, before their activations, of series that a network has given the coefficients of."""

from typing import Any

import torch
from torch import Tensor

from .backend import choose
from .checks import check_shapes
from .op import op


def series_sums(coefficients: Tensor, basis: Tensor) -> Tensor:
    """Sums of four series: the first one over D of K basis functions, the others over all.

    `a_0 = sum_{j < D} c_j b_j` and `a_i = sum_{j < K} c_{D + (i - 1) K + j} b_j` for i = 1, 2, 3: density follows time,
    and colours time and direction.

    Args:
        coefficients: (N, D + 3 K), differentiable; D of 1 to K.
        basis: (N, K), of each sample, differentiable.

    Returns:
        (N, 4), in the wider dtype of the arguments and at least float32.

    Raises:
        ValueError: a shape that does not fit.

    The compiled version is differentiable once; second derivatives need `use_backend("reference")`.
    """
    check_shapes(coefficients=(coefficients, ("N", "D + 3 K")), basis=(basis, (len(coefficients), "K")))
    terms = basis.shape[1]
    if not 0 < coefficients.shape[1] - 3 * terms <= terms:
        raise ValueError(
            f"coefficients must have D + 3 K columns, 0 < D <= K = {terms}, got {coefficients.shape[1]}: as many for "
            "each colour as the basis has functions"
        )
    dtype = torch.promote_types(torch.promote_types(coefficients.dtype, basis.dtype), torch.float32)
    basis = basis.to(dtype)
    if choose(basis) == "numba":
        is_short = coefficients.dtype == torch.bfloat16 and dtype == torch.float32
        return _series_sums(coefficients if is_short else coefficients.to(dtype), basis)
    return series_sums_reference(coefficients.to(dtype), basis)


def series_sums_reference(coefficients: Tensor, basis: Tensor) -> Tensor:
    """The definition of `series_sums` in plain torch."""
    terms = basis.shape[1]
    first, others = coefficients.tensor_split([coefficients.shape[1] - 3 * terms], dim=1)
    sums = (first * basis[:, : first.shape[1]]).sum(1), (others.unflatten(1, (3, terms)) * basis[:, None]).sum(2)
    return torch.cat([sums[0][:, None], sums[1]], dim=1)


_grad_coefficients = op(
    "series_sums_grad_coefficients(Tensor grad, Tensor basis, Tensor like) -> Tensor",
    "series_sums.grad_coefficients", gradient_of="series_sums",
)  # fmt: skip
_grad_basis = op(
    "series_sums_grad_basis(Tensor grad, Tensor coefficients, int terms) -> Tensor",
    "series_sums.grad_basis", gradient_of="series_sums",
)  # fmt: skip


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
    coefficients, basis = ctx.saved_tensors
    needs_coefficients, needs_basis = ctx.needs_input_grad
    to_coefficients = _grad_coefficients(grad, basis, coefficients) if needs_coefficients else None
    return to_coefficients, _grad_basis(grad, coefficients, basis.shape[1]) if needs_basis else None


_series_sums = op(
    "series_sums(Tensor coefficients, Tensor basis) -> Tensor", "series_sums.forward", backward=_backward,
    setup_context=_save,
)  # fmt: skip
