"""Vector instructions on rows of a contiguous 2-D array, for use inside numba kernels.

numba's loops over a row's few features vectorise badly: LLVM must assume that arrays overlap. These intrinsics
emit one vector operation per row; its width is the length of the tuple `lanes`, a compile-time constant.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

FLAGS = ("contract", "nsz")


def vector_pointer(context: Any, builder: Any, array_type: Any, array: Any, start: Any, width: int) -> Any:
    """Pointer to `width` consecutive elements of an array from flat index `start`."""
    data = context.make_array(array_type)(context, builder, array).data
    vector = ir.VectorType(context.get_data_type(array_type.dtype), width)
    return builder.bitcast(builder.gep(data, [start]), vector.as_pointer())


def load(context: Any, builder: Any, array_type: Any, array: Any, start: Any, width: int) -> Any:
    """So many consecutive elements of an array from flat index `start`."""
    pointer = vector_pointer(context, builder, array_type, array, start, width)
    return builder.load(pointer, align=array_type.dtype.bitwidth // 8)


def splat(builder: Any, value: Any, width: int) -> Any:
    """A vector of one number."""
    vector = ir.VectorType(value.type, width)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), width), [0] * width)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


@intrinsic
def blend_rows(
    typing: Any, table: Any, first: Any, rows: Any, fractions: Any, out: Any, start: Any, lanes: Any
) -> tuple[Any, Any]:
    """out.flat[start : start + F] = the trilinear interpolation of eight rows table[first + rows[k]].

    Bit 0 of k belongs to the first fraction, bit 1 to the second and bit 2 to the third. Pair after pair, which takes
    half the instructions that a sum of eight rows with their weights does. `out` in bfloat16 is given as uint16; it
    gets numbers of single precision, rounded to the nearest, ties to even.
    """
    width = lanes.count

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        table_, first_, rows_, fractions_, out_, start_, _ = arguments
        values = _corner_rows(context, builder, table, table_, first_, rows_, width)
        for axis in range(3):
            shares = _shares(builder, builder.extract_value(fractions_, axis), width)
            pairs = zip(values[::2], values[1::2], strict=True)
            values = [_between(builder, low, high, shares) for low, high in pairs]
        value = _rounded(builder, values[0], width) if out.dtype == types.uint16 else values[0]
        builder.store(value, vector_pointer(context, builder, out, out_, start_, width), align=out.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(table, first, rows, fractions, out, start, lanes), generate


def _corner_rows(context: Any, builder: Any, table: Any, array: Any, first: Any, rows: Any, width: int) -> list[Any]:
    """The eight rows of a cell."""
    numbers = [builder.add(first, builder.extract_value(rows, k)) for k in range(8)]
    starts = [builder.mul(number, ir.Constant(ir.IntType(64), width)) for number in numbers]
    return [load(context, builder, table, array, start, width) for start in starts]


def _shares(builder: Any, fraction: Any, width: int) -> tuple[Any, Any]:
    """The shares of a pair, as vectors: 1 - fraction, and fraction."""
    high = splat(builder, fraction, width)
    return builder.fsub(ir.Constant(high.type, [1.0] * width), high, flags=FLAGS), high


def _between(builder: Any, low: Any, high: Any, shares: tuple[Any, Any]) -> Any:
    """Exact at both ends."""
    below, above = (builder.fmul(x, share, flags=FLAGS) for x, share in zip((low, high), shares, strict=True))
    return builder.fadd(below, above, flags=FLAGS)


def _rounded(builder: Any, values: Any, width: int) -> Any:
    """The bits of a float32 vector in bfloat16, which is the upper half of each number's."""
    word = ir.VectorType(ir.IntType(32), width)

    def constant(number: int) -> Any:
        return ir.Constant(word, [number] * width)

    bits = builder.bitcast(values, word)
    is_odd = builder.and_(builder.lshr(bits, constant(16)), constant(1))
    rounded = builder.add(bits, builder.add(is_odd, constant(0x7FFF)))
    is_nan = builder.fcmp_unordered("uno", values, values)
    kept = builder.select(is_nan, constant(0x7FC00000), rounded)
    return builder.trunc(builder.lshr(kept, constant(16)), ir.VectorType(ir.IntType(16), width))


@intrinsic
def add_to_row(typing: Any, table: Any, row: Any, weight: Any, values: Any, start: Any, lanes: Any) -> tuple[Any, Any]:
    """table[row] += weight * values.flat[start : start + F]."""
    width = lanes.count

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        table_, row_, weight_, values_, start_, _ = arguments
        index = builder.mul(row_, ir.Constant(ir.IntType(64), width))
        pointer = vector_pointer(context, builder, table, table_, index, width)
        align = table.dtype.bitwidth // 8
        values_v = load(context, builder, values, values_, start_, width)
        term = builder.fmul(splat(builder, weight_, width), values_v, flags=FLAGS)
        total = builder.fadd(builder.load(pointer, align=align), term, flags=FLAGS)
        builder.store(total, pointer, align=align)
        return context.get_dummy_value()

    return types.void(table, row, weight, values, start, lanes), generate


@intrinsic
def dot_slopes(
    typing: Any, table: Any, first: Any, rows: Any, fractions: Any, values: Any, start: Any, lanes: Any
) -> tuple[Any, Any]:
    """Derivatives to the three fractions of `sum_f values.flat[start + f] * blend[f]`.

    `blend` is what `blend_rows` makes of the eight rows.
    """
    width = lanes.count
    scalar = table.dtype

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        table_, first_, rows_, fractions_, values_, start_, _ = arguments

        def subtract(a: Any, b: Any) -> Any:
            return builder.fsub(a, b, flags=FLAGS)

        def blend(a: Any, b: Any, axis: int) -> Any:
            return _between(builder, a, b, shares[axis])

        shares = [_shares(builder, builder.extract_value(fractions_, axis), width) for axis in range(3)]
        row = _corner_rows(context, builder, table, table_, first_, rows_, width)
        across = [subtract(row[k + 1], row[k]) for k in (0, 2, 4, 6)]
        along = [blend(row[k], row[k + 1], 0) for k in (0, 2, 4, 6)]
        slopes = (
            blend(blend(across[0], across[1], 1), blend(across[2], across[3], 1), 2),
            blend(subtract(along[1], along[0]), subtract(along[3], along[2]), 2),
            subtract(blend(along[2], along[3], 1), blend(along[0], along[1], 1)),
        )
        gradient = load(context, builder, values, values_, start_, width)
        sums = [_sum(builder, builder.fmul(slope, gradient, flags=FLAGS)) for slope in slopes]
        return context.make_tuple(builder, signature.return_type, sums)

    return types.UniTuple(scalar, 3)(table, first, rows, fractions, values, start, lanes), generate


def _sum(builder: Any, vector: Any) -> Any:
    scalar = vector.type.element
    bits = 32 if isinstance(scalar, ir.FloatType) else 64
    reduce = cgutils.get_or_insert_function(
        builder.module,
        ir.FunctionType(scalar, [scalar, vector.type]),
        f"llvm.vector.reduce.fadd.v{vector.type.count}f{bits}",
    )
    # Without reassoc the reduction would add lane after lane.
    return builder.call(reduce, [ir.Constant(scalar, 0.0), vector], fastmath=("reassoc", *FLAGS))


@intrinsic
def trailing_zeros(typing: Any, word: Any) -> tuple[Any, Any]:
    """Number of zero bits below the lowest set bit of an unsigned integer that is not zero."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return word(word), generate
