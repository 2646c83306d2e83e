# mypy: disable-error-code="call-arg,var-annotated"
"""What a frame's tables hold at a distance along a ray, for the numba version of `trace`."""

import math
from typing import Any

import numpy as np
from numba import njit

from ..brick_lookup import BRICK_BITS
from ..shade import MOST_LOG_DENSITY
from ..trace import ELSEWHERE, LACKS_BRICK, LACKS_VERTEX
from .brick_lookup import CORNERS, SIDE, cell_of, first_row, is_inside
from .cells import locate
from .exponential import exp, expm1
from .launch import BORROWS, FAST
from .rows import blend_rows, prefetch_row

NUM_ADDED = 4  # numbers behind the displacement of a lattice's row, if it has them
GOES_ON = 0  # between what ends a ray and what it may lack


@njit(forceinline=True, **BORROWS)
def find(middle: Any, course: Any, lattice: Any, contents: Any, found: Any, i: int, moved: Any) -> Any:
    """Find in which row the contents at a distance begin, the fractions in its cell, what is added; or what lacks."""
    why, (x, y, z), (px, py, pz) = brick_at(middle, course, lattice, contents, moved)
    if why != GOES_ON:
        return why
    slots, bricks = contents[0], contents[1]
    row = first_row(x, y, z, slots[x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS])
    for corner in (row, row + SIDE, row + SIDE * SIDE, row + SIDE * SIDE + SIDE):
        prefetch_row(bricks, corner)
        prefetch_row(bricks, corner + 1)
    rows, fractions = found
    rows[i] = row
    fractions[i, 0], fractions[i, 1], fractions[i, 2] = px - np.float32(x), py - np.float32(y), pz - np.float32(z)
    if len(lattice[4]) > NUM_ADDED:
        for k in range(NUM_ADDED):
            fractions[i, 3 + k] = moved[4 + k]
    return GOES_ON


@njit(forceinline=True, **BORROWS)
def added(found: Any, i: int, k: int, lattice: Any) -> Any:
    """What the lattice adds to a sum of terms: k = 0 is density's."""
    return found[1][i, 3 + k] if len(lattice[4]) > NUM_ADDED else np.float32(0)


@njit(forceinline=True, **BORROWS)
def brick_at(middle: Any, course: Any, lattice: Any, contents: Any, moved: Any) -> Any:
    """Whether a distance lies in a brick that exists, or why not; its cell; and the place, in cells."""
    displacements, is_known, low, sides, lanes = lattice
    slots, _, brick_low, cells_per_unit = contents[:4]
    is_in, (px, py, pz), (x, y, z), fractions = place_at(middle, course[:2], is_known.shape, low, sides)
    if not is_in:
        return ELSEWHERE, (x, y, z), (px, py, pz)
    blend_vertices(displacements, is_known.shape, (x, y, z), fractions, moved, lanes)
    if math.isnan(moved[0]):
        return LACKS_VERTEX, (x, y, z), (px, py, pz)
    px = (px + moved[0] - brick_low[0]) * cells_per_unit
    py = (py + moved[1] - brick_low[1]) * cells_per_unit
    pz = (pz + moved[2] - brick_low[2]) * cells_per_unit
    if not is_inside(px, py, pz, slots):
        return ELSEWHERE, (x, y, z), (px, py, pz)
    x, y, z = cell_of(px, py, pz, slots)
    exists = slots[x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS] >= 0
    return GOES_ON if exists else LACKS_BRICK, (x, y, z), (px, py, pz)


@njit(forceinline=True, **BORROWS)
def blend_vertices(displacements: Any, shape: Any, cell: Any, fractions: Any, moved: Any, lanes: Any) -> None:
    """Interpolate in a cell of a lattice of (z, y, x) vertices; `moved` gets the row."""
    x, y, z = cell
    _, ly, lx = shape
    c = lx * ly
    corners = 0, 1, lx, lx + 1, c, c + 1, c + lx, c + lx + 1
    blend_rows(displacements, np.int64(x + lx * (y + ly * z)), corners, fractions, moved, 0, lanes)


@njit(forceinline=True, **BORROWS)
def place_at(middle: Any, ray: Any, shape: Any, low: Any, sides: Any) -> Any:
    """Whether a distance along a ray lies in a lattice of (z, y, x) vertices, its position, its cell there, and the
    fractions in the cell."""
    (ox, oy, oz), (dx, dy, dz) = ray
    one, zero = np.float32(1), np.float32(0)
    px, py, pz = ox + middle * dx, oy + middle * dy, oz + middle * dz
    u, v, w = (px - low[0]) / sides[0], (py - low[1]) / sides[1], (pz - low[2]) / sides[2]
    is_in = zero <= u <= one and zero <= v <= one and zero <= w <= one
    lz, ly, lx = shape
    x, u = locate(u, lx - 1)
    y, v = locate(v, ly - 1)
    z, w = locate(w, lz - 1)
    return is_in, (px, py, pz), (x, y, z), (u, v, w)


@njit(forceinline=True, **BORROWS)
def log_density_at(found: Any, i: int, lattice: Any, contents: Any, values: Any, lanes: Any) -> Any:
    """Look up the contents at a place that was found; the logarithm of their density."""
    rows, fractions = found
    bricks, waves, log_shift = contents[1], contents[4], contents[5]
    places = fractions[i, 2], fractions[i, 1], fractions[i, 0]
    blend_rows(bricks, rows[i], CORNERS, places, values, 0, lanes)
    raw, most = log_shift + sum_of_terms(values, 0, waves) + added(found, i, 0, lattice), np.float32(MOST_LOG_DENSITY)
    return most if raw > most else raw


@njit(forceinline=True, **BORROWS)
def opacity_of(log_density: Any, length: Any) -> Any:
    """What an interval absorbs."""
    return -expm1(-exp(log_density) * length)


@njit(fastmath=FAST | {"reassoc"}, **BORROWS)
def sum_of_terms(values: Any, first: int, waves: Any) -> Any:
    """The sum of a series' terms times their waves."""
    total = np.float32(0)
    for k in range(len(waves)):
        total += values[first + k] * waves[k]
    return total
