# mypy: disable-error-code="attr-defined,call-arg"
"""Layers of networks in bfloat16, for use inside numba kernels, on processors that multiply vectors of such numbers.

Matrix libraries go through all rows layer by layer, and memory in between. Here sums for a group of rows stay in
registers while a layer's weights pass by, and a few hundred rows go through all layers before the next ones begin.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import llvmlite.binding
import numba
import numpy as np
import torch
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from torch import Tensor

from dnerf.core.checks import check_shape

from .launch import BORROWS
from .rows import splat, vector_pointer

LANES = 16  # float32 numbers in a vector
ROWS_OF = {4: 6, 2: 12, 1: 12}  # rows at once, by vectors of outputs at once: sums for 24 of 32 registers, or enough
MOST_ROWS = max(ROWS_OF.values())
TESTED_LLVM = (22, 0, 0)  # older ones declare the instructions in another way


class _BFloat(ir.Type):
    """LLVM's bfloat, for which llvmlite has no name."""

    def __str__(self) -> str:
        return "bfloat"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _BFloat)

    def __hash__(self) -> int:
        return hash(_BFloat)


WORD = ir.IntType(32)
SINGLES = ir.VectorType(ir.FloatType(), LANES)
HALVES, PAIRS = ir.VectorType(_BFloat(), LANES), ir.VectorType(_BFloat(), 2 * LANES)


@cache
def has_vectors() -> bool:
    """Whether the processor multiplies vectors in bfloat16."""
    if numba.config.CPU_NAME or numba.config.CPU_FEATURES:  # somebody wants code for another processor
        return False
    has_them = bool(llvmlite.binding.get_host_cpu_features().get("avx512bf16"))
    return has_them and llvmlite.binding.llvm_version_info >= TESTED_LLVM


@cache
def is_supported() -> bool:
    """Whether it does, and does not multiply whole tiles, which matrix libraries make use of."""
    return has_vectors() and not llvmlite.binding.get_host_cpu_features().get("amx-bf16")


def vectors_at_once(widths: Sequence[int]) -> int:
    """Vectors of outputs that layers of such widths, in multiples of `LANES`, find at once."""
    return next(count for count in ROWS_OF if all(width % (count * LANES) == 0 for width in widths))


class Packed:
    """Weights and biases of layers as `dense` reads them.

    Args:
        in_features: of the first layer.
        weights, biases: of each layer, (out_features, in_features) in bfloat16 of an even number, and (out_features,).
        vectors: of outputs that each layer finds at once; the last outputs are padded with zeros.

    Attributes:
        weights: flat, uint16: block of outputs by block, pair of inputs by pair.
        biases: flat, float32.
        layers: (L, 4) int64: pairs of inputs, blocks of outputs, and where weights and biases begin.

    Raises:
        ValueError: for layers that do not fit each other.
    """

    def __init__(
        self, in_features: int, weights: Sequence[Tensor], biases: Sequence[Tensor], vectors: Sequence[int]
    ) -> None:
        expected = in_features
        for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            check_shape(f"weights of layer {i}", weight, ("n", expected))
            check_shape(f"biases of layer {i}", bias, weight.shape[:1])
            expected = len(weight)
        layers, num_weights, num_outputs = [], 0, 0
        for weight, count in zip(weights, vectors, strict=True):
            out_features, in_features = weight.shape
            blocks = -(-out_features // (count * LANES))
            layers.append((in_features // 2, blocks, num_weights, num_outputs))
            num_weights += blocks * count * LANES * in_features
            num_outputs += blocks * count * LANES
        self.layers = np.array(layers, np.int64)
        self.weights, self.biases = np.zeros(num_weights, np.uint16), np.zeros(num_outputs, np.float32)
        for (_, _, start, first), weight, bias, count in zip(layers, weights, biases, vectors, strict=True):
            _pack(bits_of(weight), self.weights[start:], count * LANES)
            self.biases[first : first + len(bias)] = bias.detach().bfloat16().float().numpy()


def bits_of(tensor: Tensor) -> np.ndarray:
    """Of numbers in bfloat16."""
    return tensor.detach().contiguous().view(torch.int16).numpy().view(np.uint16)


@njit(**BORROWS)
def _pack(weight: Any, packed: Any, columns: int) -> None:
    num_outputs, num_inputs = weight.shape
    for i in range(num_outputs):
        block, column = divmod(i, columns)
        for k in range(num_inputs):
            pair, half = divmod(k, 2)
            packed[((block * (num_inputs // 2) + pair) * columns + column) * 2 + half] = weight[i, k]


@njit(**BORROWS)
def dense(
    inputs: Any, from_row: int, layer: Any, weights: Any, biases: Any, out: Any, to_row: int, count: int, group: Any,
    vectors: Any,
) -> None:  # fmt: skip
    """What a layer makes of `count` rows, and of as many more as complete a group: ReLU(W x + b) for outputs in
    bfloat16 (uint16), W x + b for outputs in float32.

    Args:
        inputs, from_row: flat, uint16, and the first row of them.
        layer, weights, biases: of `Packed`.
        out, to_row: flat, in rows as long as the layer's blocks are, and the first row of them.
        group, vectors: tuples as long as rows, and vectors of outputs, at once are many.
    """
    pairs, blocks, start, first = layer
    columns = len(vectors) * LANES
    width = blocks * columns
    for block in range(blocks):
        for i in range(0, count, len(group)):
            _dense_rows(
                inputs, (from_row + i) * pairs * 2, pairs, weights, start + block * pairs * columns * 2,
                biases, first + block * columns, out, (to_row + i) * width + block * columns, width, group, vectors,
            )  # fmt: skip


@intrinsic
def _dense_rows(
    typing: Any, inputs: Any, first: Any, pairs: Any, weights: Any, start: Any, biases: Any, first_bias: Any, out: Any,
    first_out: Any, width: Any, group: Any, vectors: Any,
) -> tuple[Any, Any]:  # fmt: skip
    """One group of rows and one block of outputs; sums are kept in registers."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        inputs_, first_, pairs_, weights_, start_, biases_, first_bias_, out_, first_out_, width_, _, _ = arguments
        long = ir.IntType(64)

        def after(start: Any, number: Any, factor: Any) -> Any:
            factor = long(factor) if isinstance(factor, int) else factor
            return builder.add(start, builder.mul(long(number) if isinstance(number, int) else number, factor))

        def data(array_type: Any, array: Any, at: Any, kind: Any) -> Any:
            pointer = builder.gep(context.make_array(array_type)(context, builder, array).data, [at])
            return builder.bitcast(pointer, kind.as_pointer())

        sums = [[cgutils.alloca_once(builder, SINGLES) for _ in range(vectors.count)] for _ in range(group.count)]
        for n in range(vectors.count):
            bias = vector_pointer(context, builder, biases, biases_, after(first_bias_, n, LANES), LANES)
            for line in sums:
                builder.store(builder.load(bias, align=4), line[n])
        multiply = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(SINGLES, [SINGLES, PAIRS, PAIRS]), "llvm.x86.avx512bf16.dpbf16ps.512"
        )
        with cgutils.for_range(builder, pairs_) as loop:
            here = after(start_, loop.index, 2 * LANES * vectors.count)
            parts = [data(weights, weights_, after(here, n, 2 * LANES), PAIRS) for n in range(vectors.count)]
            passing = [builder.load(part, align=2) for part in parts]
            for row, line in enumerate(sums):
                at = after(after(first_, row, builder.mul(pairs_, long(2))), loop.index, 2)
                pair = builder.load(data(inputs, inputs_, at, WORD), align=2)
                values = builder.bitcast(splat(builder, pair, LANES), PAIRS)
                for total, weight in zip(line, passing, strict=True):
                    builder.store(builder.call(multiply, [builder.load(total), values, weight]), total)
        shorten = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(HALVES, [SINGLES]), "llvm.x86.avx512bf16.cvtneps2bf16.512"
        )
        zeros = ir.Constant(SINGLES, [0.0] * LANES)
        for row, line in enumerate(sums):
            for n, total in enumerate(line):
                value = builder.load(total)
                if out.dtype == types.uint16:
                    is_below = builder.fcmp_ordered("<", value, zeros)  # NaN is not, and stays
                    value = builder.call(shorten, [builder.select(is_below, zeros, value)])
                pointer = data(out, out_, after(after(first_out_, row, width_), n, LANES), value.type)
                builder.store(value, pointer, align=out.dtype.bitwidth // 8)
        return context.get_dummy_value()

    arguments = (inputs, first, pairs, weights, start, biases, first_bias, out, first_out, width, group, vectors)
    return types.void(*arguments), generate
