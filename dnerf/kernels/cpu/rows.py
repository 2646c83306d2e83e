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
    if array_type.dtype == types.uint16:  # half precision: numba has no such numbers, processors do
        data = context.make_array(array_type)(context, builder, array).data
        pointer = builder.bitcast(builder.gep(data, [start]), ir.VectorType(ir.HalfType(), width).as_pointer())
        return builder.fpext(builder.load(pointer, align=2), ir.VectorType(ir.FloatType(), width))
    pointer = _vector_pointer(context, builder, array_type, array, start, width)
    return builder.load(pointer, align=array_type.dtype.bitwidth // 8)


def _splat(builder: Any, value: Any, width: int) -> Any:
    vector = ir.VectorType(value.type, width)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), width), [0] * width)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


@intrinsic
def blend_rows(typing: Any, table: Any, rows: Any, weights: Any, out: Any, start: Any, lanes: Any) -> tuple[Any, Any]:
    """out.flat[start : start + F] = sum_k weights[k] * table[rows[k]], for tuples of rows and weights.

    A table in half precision is given as uint16; weights and `out` are then in single precision. `out` in bfloat16 is
    given as uint16, too; it gets numbers of single precision, rounded to the nearest, ties to even.
    """
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
        total = _rounded(builder, total, width) if out.dtype == types.uint16 else total
        builder.store(total, pointer, align=out.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(table, rows, weights, out, start, lanes), generate


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
def prefetch_row(typing: Any, table: Any, row: Any) -> tuple[Any, Any]:
    """Ask for the memory in which a row begins; it is read later."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(table)(context, builder, arguments[0])
        width = builder.extract_value(array.shape, 1)
        byte = ir.IntType(8).as_pointer()
        pointer = builder.bitcast(builder.gep(array.data, [builder.mul(arguments[1], width)]), byte)
        flag = ir.IntType(32)
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag]), "llvm.prefetch.p0"
        )
        builder.call(function, [pointer, flag(0), flag(3), flag(1)])  # to read, to keep, data
        return context.get_dummy_value()

    return types.void(table, row), generate


@intrinsic
def add_to_row(typing: Any, table: Any, row: Any, weight: Any, values: Any, start: Any, lanes: Any) -> tuple[Any, Any]:
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
def dot_slopes(
    typing: Any, table: Any, rows: Any, fractions: Any, values: Any, start: Any, lanes: Any
) -> tuple[Any, Any]:
    """Derivatives to the three fractions of `sum_f values.flat[start + f] * blend[f]`.

    `blend` is the trilinear interpolation of the 8 rows, bit 0 of whose number is x, bit 1 y and bit 2 z.
    """
    width = lanes.count
    scalar = table.dtype

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        table_, rows_, fractions_, values_, start_, _ = arguments

        def subtract(a: Any, b: Any) -> Any:
            return builder.fsub(a, b, flags=FLAGS)

        def blend(a: Any, b: Any, axis: int) -> Any:
            return builder.fadd(a, builder.fmul(fraction[axis], subtract(b, a), flags=FLAGS), flags=FLAGS)

        fraction = [_splat(builder, builder.extract_value(fractions_, a), width) for a in range(3)]
        row = []
        for k in range(8):
            index = builder.mul(builder.extract_value(rows_, k), ir.Constant(ir.IntType(64), width))
            row.append(_load(context, builder, table, table_, index, width))
        across = [subtract(row[k + 1], row[k]) for k in (0, 2, 4, 6)]
        along = [blend(row[k], row[k + 1], 0) for k in (0, 2, 4, 6)]
        slopes = (
            blend(blend(across[0], across[1], 1), blend(across[2], across[3], 1), 2),
            blend(subtract(along[1], along[0]), subtract(along[3], along[2]), 2),
            subtract(blend(along[2], along[3], 1), blend(along[0], along[1], 1)),
        )
        gradient = _load(context, builder, values, values_, start_, width)
        sums = [_sum(builder, builder.fmul(slope, gradient, flags=FLAGS)) for slope in slopes]
        return context.make_tuple(builder, signature.return_type, sums)

    return types.UniTuple(scalar, 3)(table, rows, fractions, values, start, lanes), generate


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
