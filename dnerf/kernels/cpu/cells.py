# mypy: disable-error-code="call-arg"
"""Cells of a grid's levels around many places at once, in vector instructions, for use inside numba kernels.

To find a place's cell, fractions and eight table rows takes more instructions than to interpolate. Here they are found
for `AT_ONCE` places together, one in each lane, and written into a small table of the thread's own.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from ..grid_encode import HASH_PRIMES
from .launch import BORROWS, FAST
from .rows import load, splat, vector_pointer

PLACES = 256  # of which a thread's table has room
AT_ONCE = 16

ZERO, ONE, NOWHERE = np.float32(0), np.float32(1), np.float32(np.nan)
WORD, LONG = ir.IntType(32), ir.IntType(64)


def cell_tables(dtype: Any, num_workers: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each worker's places (W, 3, n), fractions (W, 3, n) and rows (W, 8, n)."""
    places = np.zeros((2, num_workers, 3, PLACES), dtype)
    return places[0], places[1], np.zeros((num_workers, 8, PLACES), np.uint32)


@njit(fastmath=FAST, **BORROWS)
def take_places(positions: Any, first: int, places: Any) -> int:
    """Clamp up to `PLACES` positions (N, 3) from `first` on to the unit cube, and say how many; NaN stays NaN."""
    count = min(PLACES, positions.shape[0] - first)
    for i in range(count):
        for axis in range(3):
            places[axis, i] = clamped(positions[first + i, axis])
    return count


@njit(fastmath=FAST, **BORROWS)
def clamped(position: Any) -> Any:
    """The nearest number in [0, 1]; NaN for NaN."""
    one, zero = type(position)(1), type(position)(0)
    return zero if position < zero else (one if position > one else position)


@njit(fastmath=FAST, **BORROWS)
def locate_all(places: Any, count: int, level: Any, rows: Any, fractions: Any) -> None:
    """Rows and fractions of a level, as `GridLevels.describe` gives it, at so many places."""
    numbers = (level[0], level[1], level[2], level[4])
    for i in range(0, count, AT_ONCE):
        _locate_some(places, i, numbers, rows, fractions)


@njit(**BORROWS)
def locate_in_lattice(places: Any, count: int, lattice: Any, rows: Any, fractions: Any) -> None:
    """`locate_all` of positions, which become shares of a lattice's sides (NaN outside): level, corner, sides."""
    level, low, sides = lattice
    for axis in range(3):
        line = places[axis]
        for i in range(count):
            share = (line[i] - low[axis]) / sides[axis]
            line[i] = share if ZERO <= share <= ONE else NOWHERE
    locate_all(places, count, level, rows, fractions)


@intrinsic
def _locate_some(typing: Any, places: Any, i: Any, level: Any, rows: Any, fractions: Any) -> tuple[Any, Any]:
    """For lanes i to i + `AT_ONCE`; a NaN gives vertex 0 and fraction NaN, never a wild index."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        places_, i_, level_, rows_, fractions_ = arguments
        real = context.get_data_type(places.dtype)
        reals, words = ir.VectorType(real, AT_ONCE), ir.VectorType(WORD, AT_ONCE)

        def spread(number: Any) -> Any:
            return splat(builder, builder.trunc(number, WORD), AT_ONCE)

        def constant(number: int) -> Any:
            return ir.Constant(words, [number] * AT_ONCE)

        def store(values: Any, array_type: Any, array: Any, line: int) -> None:
            pointer = vector_pointer(context, builder, array_type, array, _place(builder, line, i_), AT_ONCE)
            builder.store(values, pointer, align=array_type.dtype.bitwidth // 8)

        cells = [builder.extract_value(level_, axis) for axis in range(3)]
        is_deep = builder.zext(builder.icmp_signed(">", cells[2], LONG(0)), LONG)  # or a plane
        lower = []
        for axis, size in enumerate(cells):
            place = load(context, builder, places, places_, _place(builder, axis, i_), AT_ONCE)
            scaled = builder.fmul(place, splat(builder, builder.sitofp(size, real), AT_ONCE))
            is_number = builder.fcmp_ordered("ord", scaled, scaled)
            known = builder.fptosi(builder.select(is_number, scaled, ir.Constant(reals, [0.0] * AT_ONCE)), words)
            last = builder.sub(spread(size), spread(is_deep) if axis == 2 else constant(1))
            vertex = builder.select(builder.icmp_signed("<", known, last), known, last)
            store(builder.fsub(scaled, builder.sitofp(vertex, reals)), fractions, fractions_, axis)
            lower.append(vertex)

        x, y, z = lower
        row_y = builder.add(spread(cells[0]), constant(1))
        row_z = builder.mul(row_y, builder.add(spread(cells[1]), constant(1)))
        first = builder.add(x, builder.add(builder.mul(y, row_y), builder.mul(z, row_z)))
        row_z = builder.mul(row_z, spread(is_deep))
        mask = builder.extract_value(level_, 3)
        is_hashed, masks = builder.icmp_signed(">=", mask, LONG(0)), spread(mask)
        primes = [constant(prime) for prime in HASH_PRIMES]
        bits = [[builder.mul(number, prime)] for number, prime in zip(lower, primes, strict=True)]
        for pair, prime in zip(bits, primes, strict=True):
            pair.append(builder.add(pair[0], prime))
        for k in range(8):
            up_x, up_y, up_z = k & 1, k >> 1 & 1, k >> 2
            mixed = builder.xor(bits[0][up_x], builder.xor(bits[1][up_y], bits[2][up_z]))
            dense = builder.add(first, constant(1)) if up_x else first
            dense = builder.add(dense, row_y) if up_y else dense
            dense = builder.add(dense, row_z) if up_z else dense
            store(builder.select(is_hashed, builder.and_(mixed, masks), dense), rows, rows_, k)
        return context.get_dummy_value()

    return types.void(places, i, level, rows, fractions), generate


def _place(builder: Any, line: int, i: Any) -> Any:
    return builder.add(LONG(line * PLACES), i)


@intrinsic
def rows_at(typing: Any, rows: Any, i: Any) -> tuple[Any, Any]:
    """The eight rows within the level of place i; bit 0 of the vertex number is x, bit 1 y, bit 2 z."""
    return _column(rows, i, 8, types.int64)


@intrinsic
def fractions_at(typing: Any, fractions: Any, i: Any) -> tuple[Any, Any]:
    """The three fractions in its cell of place i."""
    return _column(fractions, i, 3, fractions.dtype)


def _column(array: Any, i: Any, num_lines: int, result: Any) -> tuple[Any, Any]:
    """Column i of a worker's table, as a tuple."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(array)(context, builder, arguments[0]).data
        numbers = [builder.load(builder.gep(data, [_place(builder, k, arguments[1])])) for k in range(num_lines)]
        if array.dtype == types.uint32:
            numbers = [builder.zext(number, LONG) for number in numbers]
        return context.make_tuple(builder, signature.return_type, numbers)

    return types.UniTuple(result, num_lines)(array, i), generate


@njit(fastmath=FAST, **BORROWS)
def trilinear_weights(u: Any, v: Any, w: Any) -> Any:
    """Trilinear weights of the 8 vertices; bit 0 of the vertex number is u's, bit 1 v's, bit 2 w's."""
    one = type(u)(1)
    a, b, c, d = (one - v) * (one - w), v * (one - w), (one - v) * w, v * w
    return (one - u) * a, u * a, (one - u) * b, u * b, (one - u) * c, u * c, (one - u) * d, u * d
