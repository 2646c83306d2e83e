"""Calls under one of the kernels' backends, and kernels in bfloat16 on every processor."""

import sys
from collections.abc import Callable
from typing import Any

import pytest
from llvmlite import ir

from dnerf import kernels
from dnerf.kernels.cpu import dense, rows


def under(backend: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """What a function returns while a backend is selected."""
    with kernels.use_backend(backend):
        return function(*arguments, **options)


def serve_bfloat16(patch: pytest.MonkeyPatch) -> None:
    """Networks in bfloat16 are served on every CPU; where its two instructions are missing, they are emulated."""
    if not dense.has_vectors():
        patch.setattr(dense, "instruction", _emulated)
        patch.setattr(sys.modules["dnerf.kernels.relu_layers"], "has_bfloat16", lambda device: True)
    for name in ("relu_layers.is_supported", "grid_network.is_supported", "grid_network.has_vectors"):
        patch.setattr(f"dnerf.kernels.cpu.{name}", lambda: True)


def _emulated(builder: Any, name: str, result: ir.Type, total: Any, *factors: Any) -> Any:
    if name == "cvtneps2bf16":
        return rows._rounded(builder, total, dense.LANES)
    words = ir.VectorType(ir.IntType(32), dense.LANES)
    low, high = (ir.Constant(words, [number] * dense.LANES) for number in (16, 0xFFFF0000))
    for half in (lambda pair: builder.shl(pair, low), lambda pair: builder.and_(pair, high)):
        left, right = (builder.bitcast(half(builder.bitcast(factor, words)), result) for factor in factors)
        total = builder.fadd(total, builder.fmul(left, right))
    return total
