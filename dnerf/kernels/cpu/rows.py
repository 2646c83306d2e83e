"""Vector instructions on rows of a contiguous 2-D array, for use inside numba kernels.

numba's loop over a row's few features neither unrolls nor vectorises well, since LLVM must assume that the arrays
overlap. These intrinsics emit one vector operation per row; its width is the length of the tuple `lanes`, which
makes it a compile-time constant.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

FLAGS = ("contract", "nsz")


def _vector_pointer(context: Any, builder: Any, array_type: Any, array: Any, start: Any, width: int) -> Any:
    """Pointer to `width` consecutive elements of an array from flat index `start`."""
    data = context.make_array(array_type)(context, builder, array).data
    vector = ir.VectorType(context.get_data_type(array_type.dtype), width)
    return builder.bitcast(builder.gep(data, [start]), vector.as_pointer())


def _load(context: Any, builder: Any, array_type: Any, array: Any, start: Any, width: int) -> Any:
    pointer = _vector_pointer(context, builder, array_type, array, start, width)
    return builder.load(pointer, align=array_type.dtype.bitwidth // 8)


def _splat(builder: Any, value: Any, width: int) -> Any:
    vector = ir.VectorType(value.type, width)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), width), [0] * width)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


@intrinsic
def blend_rows(
    typing: Any, table: Any, rows: Any, weights: Any, out: Any, start: Any, lanes: Any
) -> tuple[Any, Any]:
    """out.flat[start : start + F] = sum_k weights[k] * table[rows[k]], for tuples of rows and weights."""
    width = lanes.count

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        table_, rows_, weights_, out_, start_, _ = arguments
        total = None
        for k in range(rows.count):
            index = builder.mul(builder.extract_value(rows_, k), ir.Constant(ir.IntType(64), width))
            row = _load(context, builder, table, table_, index, width)
            term = builder.fmul(_splat(builder, builder.extract_value(weights_, k), width), row, flags=FLAGS)
            total = term if total is None else builder.fadd(total, term, flags=FLAGS)
        pointer = _vector_pointer(context, builder, out, out_, start_, width)
        builder.store(total, pointer, align=out.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(table, rows, weights, out, start, lanes), generate


@intrinsic
def add_to_row(
    typing: Any, table: Any, row: Any, weight: Any, values: Any, start: Any, lanes: Any
) -> tuple[Any, Any]:
    """table[row] += weight * values.flat[start : start + F]."""
    width = lanes.count

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        table_, row_, weight_, values_, start_, _ = arguments
        index = builder.mul(row_, ir.Constant(ir.IntType(64), width))
        pointer = _vector_pointer(context, builder, table, table_, index, width)
        align = table.dtype.bitwidth // 8
        values_v = _load(context, builder, values, values_, start_, width)
        term = builder.fmul(_splat(builder, weight_, width), values_v, flags=FLAGS)
        total = builder.fadd(builder.load(pointer, align=align), term, flags=FLAGS)
        builder.store(total, pointer, align=align)
        return context.get_dummy_value()

    return types.void(table, row, weight, values, start, lanes), generate


@intrinsic
def dot_row(typing: Any, table: Any, row: Any, values: Any, start: Any, lanes: Any) -> tuple[Any, Any]:
    """sum_f table[row, f] * values.flat[start + f]."""
    width = lanes.count

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        table_, row_, values_, start_, _ = arguments
        index = builder.mul(row_, ir.Constant(ir.IntType(64), width))
        product = builder.fmul(
            _load(context, builder, table, table_, index, width),
            _load(context, builder, values, values_, start_, width),
            flags=FLAGS,
        )
        scalar = product.type.element
        suffix = f"v{width}f{table.dtype.bitwidth}"
        reduce = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(scalar, [scalar, product.type]),
            f"llvm.vector.reduce.fadd.{suffix}",
        )
        # Without reassoc the reduction would add lane after lane.
        return builder.call(reduce, [ir.Constant(scalar, 0.0), product], fastmath=("reassoc", *FLAGS))

    return table.dtype(table, row, values, start, lanes), generate


@intrinsic
def trailing_zeros(typing: Any, word: Any) -> tuple[Any, Any]:
    """Number of zero bits below the lowest set bit of an unsigned integer that is not zero."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return word(word), generate
