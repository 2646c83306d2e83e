# mypy: disable-error-code="attr-defined,call-arg"
"""Layers of networks for use inside numba kernels: in float32, and in bfloat16 where vectors of it are multiplied.

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

from .launch import BORROWS, array
from .rows import FLAGS, splat, vector_pointer

LANES = 16  # float32 numbers in a vector
# Rows at once, by vectors of outputs at once: sums for 24 of 32 registers, or enough; for 12 of 16 shorter ones.
ROWS_OF, ROWS_OF_SHORT = {4: 6, 2: 12, 1: 12}, {1: 6}
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
def cpu_features() -> dict[str, bool]:
    """Of the processor; none if somebody wants code for another."""
    is_other = numba.config.CPU_NAME or numba.config.CPU_FEATURES
    return {} if is_other else dict(llvmlite.binding.get_host_cpu_features())


def has_vectors() -> bool:
    """Whether the processor multiplies vectors in bfloat16."""
    return cpu_features().get("avx512bf16", False) and llvmlite.binding.llvm_version_info >= TESTED_LLVM


def is_supported() -> bool:
    """Whether it does, and does not multiply whole tiles, which matrix libraries make use of."""
    return has_vectors() and not cpu_features().get("amx-bf16")


def at_once(widths: Sequence[int]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Tuples as long as rows, and as vectors of outputs, are many at once; of widths in multiples of `LANES`."""
    table = ROWS_OF if cpu_features().get("avx512f") else ROWS_OF_SHORT
    vectors = next(count for count in table if all(width % (count * LANES) == 0 for width in widths))
    return (0,) * table[vectors], (0,) * vectors


class Packed:
    """Weights and biases of layers as `dense` reads them.

    Args:
        in_features: of the first layer.
        weights, biases: of each layer, (out_features, in_features) and (out_features,), in float32, or in bfloat16,
            then of an even number of inputs.
        vectors: of outputs that each layer finds at once; the last outputs are padded with zeros.

    Attributes:
        weights: flat, float32 or uint16: block of outputs by block, input by input, in bfloat16 pair by pair.
        biases: flat, float32.
        layers: (L, 4) int64: inputs, blocks of outputs, and where weights and biases begin.

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
        layers, pair = [], 1 + (weights[0].dtype == torch.bfloat16)
        parts: list[np.ndarray] = []
        shifts: list[np.ndarray] = []
        for weight, bias, count in zip(weights, biases, vectors, strict=True):
            (outputs, inputs), columns = weight.shape, count * LANES
            blocks = -(-outputs // columns)
            layers.append((inputs, blocks, sum(x.size for x in parts), sum(x.size for x in shifts)))
            padding = (0, blocks * columns - outputs)
            padded = np.pad(array(weight), (padding, (0, 0))).reshape(blocks, columns, inputs // pair, pair)
            parts.append(padded.swapaxes(1, 2).ravel())
            shifts.append(np.pad(array(bias.float()), padding))
        self.layers = np.array(layers, np.int64)
        self.weights, self.biases = np.concatenate(parts), np.concatenate(shifts)


@njit(**BORROWS)
def dense(
    inputs: Any, from_row: int, layer: Any, weights: Any, biases: Any, out: Any, to_row: int, count: int, group: Any,
    vectors: Any, least: Any,
) -> None:  # fmt: skip
    """What a layer makes of `count` rows, and of as many more as complete a group: max(W x + b, least).

    Args:
        inputs, from_row: flat, float32 or uint16, as the weights are, and the first row of them.
        layer, weights, biases: of `Packed`.
        out, to_row: flat, likewise or float32, in rows as long as the layer's blocks are, and the first row of them.
        group, vectors: of `at_once`.
        least: float32, zero for a ReLU, else minus infinity.
    """
    num_inputs, blocks, start, first = layer
    columns = len(vectors) * LANES
    width = blocks * columns
    for block in range(blocks):
        for i in range(0, count, len(group)):
            _dense_rows(
                inputs, (from_row + i) * num_inputs, num_inputs, weights, start + block * num_inputs * columns, biases,
                first + block * columns, out, (to_row + i) * width + block * columns, width, group, vectors, least,
            )  # fmt: skip


def instruction(builder: Any, name: str, result: ir.Type, *operands: Any) -> Any:
    """One of AVX512-BF16."""
    kind = ir.FunctionType(result, [operand.type for operand in operands])
    return builder.call(builder.module.declare_intrinsic(f"llvm.x86.avx512bf16.{name}.512", fnty=kind), operands)


@intrinsic
def _dense_rows(
    typing: Any, inputs: Any, first: Any, num_inputs: Any, weights: Any, start: Any, biases: Any, first_bias: Any,
    out: Any, first_out: Any, width: Any, group: Any, vectors: Any, least: Any,
) -> tuple[Any, Any]:  # fmt: skip
    """One group of rows and one block of outputs; sums are kept in registers."""
    in_pair = 2 if inputs.dtype == types.uint16 else 1
    operand = PAIRS if in_pair == 2 else SINGLES

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        inputs_, first_, count_, weights_, start_, biases_, first_bias_, out_, first_out_, width_, *_, low = arguments
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

        def add(total: Any, value: Any, weight: Any) -> Any:
            if in_pair == 2:
                return instruction(builder, "dpbf16ps", SINGLES, total, value, weight)
            return builder.fadd(total, builder.fmul(value, weight, flags=FLAGS), flags=FLAGS)

        with cgutils.for_range(builder, builder.udiv(count_, long(in_pair))) as loop:
            here = after(start_, loop.index, in_pair * LANES * vectors.count)
            parts = [data(weights, weights_, after(here, n, in_pair * LANES), operand) for n in range(vectors.count)]
            passing = [builder.load(part, align=4 // in_pair) for part in parts]
            for row, line in enumerate(sums):
                at = after(after(first_, row, count_), loop.index, in_pair)
                pair = builder.load(data(inputs, inputs_, at, WORD), align=4 // in_pair)
                values = builder.bitcast(splat(builder, pair, LANES), operand)
                for total, weight in zip(line, passing, strict=True):
                    builder.store(add(builder.load(total), values, weight), total)
        lowest = splat(builder, low, LANES)
        for row, line in enumerate(sums):
            for n, total in enumerate(line):
                value = builder.load(total)
                value = builder.select(builder.fcmp_ordered("<", value, lowest), lowest, value)  # NaN is not, and stays
                if out.dtype == types.uint16:
                    value = instruction(builder, "cvtneps2bf16", HALVES, value)
                pointer = data(out, out_, after(after(first_out_, row, width_), n, LANES), value.type)
                builder.store(value, pointer, align=out.dtype.bitwidth // 8)
        return context.get_dummy_value()

    arguments = inputs, first, num_inputs, weights, start, biases, first_bias, out, first_out, width, group, vectors
    return types.void(*arguments, least), generate
