"""numba version of `blend_rigid` and its gradients."""

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ..blend_rigid import LEAST_WEIGHT, NEAREST
from .launch import BORROWS, FAST, array, kernel, launch, num_threads, rows_array


def displacements(
    points: Tensor, frames: Tensor, motions: Tensor, nodes: Tensor, radius: float
) -> tuple[Tensor, Tensor]:
    points = points.detach().contiguous()
    out, nearest = torch.empty_like(points), torch.empty((len(points), NEAREST + 1), dtype=torch.int64)
    numbers, squares = rows_array("frames", frames, len(motions)), points.new_empty((num_threads(), len(nodes)))
    launch(
        _displacements, points.numpy(), numbers, array(motions), _places(motions, nodes), _scale(points, radius),
        squares.numpy(), nearest.numpy(), out.numpy(),
    )  # fmt: skip
    return out, nearest


def gradients(
    grad: Tensor, points: Tensor, frames: Tensor, motions: Tensor, nodes: Tensor, radius: float, nearest: Tensor
) -> tuple[Tensor, Tensor]:
    grad_points = torch.empty_like(points, memory_format=torch.contiguous_format)
    grad_motions = torch.zeros_like(motions, memory_format=torch.contiguous_format)
    launch(
        _gradients, array(grad), array(points), array(frames), array(motions), _places(motions, nodes),
        _scale(points, radius), array(nearest), num_threads(), grad_points.numpy(), grad_motions.numpy(),
    )  # fmt: skip
    return grad_points, grad_motions


def _places(motions: Tensor, nodes: Tensor) -> np.ndarray:
    """Where nodes are, (F, 3, K): one coordinate of all of them in a row."""
    return array((nodes + motions[..., 3:]).mT)


def _scale(points: Tensor, radius: float) -> Any:
    """Factor of squared distances, in the points' precision."""
    return points.numpy().dtype.type(0.5 / radius**2)


@kernel(fastmath=FAST, **BORROWS)
def _displacements(
    points: Any, frames: Any, motions: Any, places: Any, scale: Any, squares: Any, nearest: Any, out: Any
) -> None:
    num_points, num_workers, num_nodes, last = points.shape[0], squares.shape[0], places.shape[2], NEAREST
    real = points.dtype.type
    for worker in prange(num_workers):
        row, begin = squares[worker], num_points * worker // num_workers
        for i in range(begin, num_points * (worker + 1) // num_workers):
            place, found = places[frames[i]], nearest[i]
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            for k in range(num_nodes):
                u, v, w = x - place[0, k], y - place[1, k], z - place[2, k]
                row[k] = u * u + v * v + w * w
            # Samples follow each other on rays: what was nearest to the last one is hardly farther than what is now.
            bound = real(math.inf)
            if i > begin and frames[i] == frames[i - 1]:
                bound = real(0)
                for j in range(last + 1):
                    bound = max(bound, row[nearest[i - 1, j]])
            _choose(row, bound, found)
            least = row[found[0]]
            end = math.exp((least - row[found[last]]) * scale)
            total, a, b, c = real(0), real(0), real(0), real(0)
            for j in range(last):
                weight = math.exp((least - row[found[j]]) * scale) - end + real(LEAST_WEIGHT)
                u, v, w = _moved(points[i], motions[frames[i]], place, found[j])
                total, a, b, c = total + weight, a + weight * u, b + weight * v, c + weight * w
            out[i, 0], out[i, 1], out[i, 2] = a / total, b / total, c / total


@njit(fastmath=FAST, **BORROWS)
def _choose(row: Any, bound: Any, found: Any) -> None:
    """Find the nodes of the smallest squares of a row, in order; as many as are wanted are no larger than a bound."""
    last, count = found.shape[0] - 1, 0
    for k in range(row.shape[0]):
        if row[k] <= bound:
            j = min(count, last)
            while j > 0 and row[k] < row[found[j - 1]]:
                found[j] = found[j - 1]
                j -= 1
            found[j] = k
            count += 1
            if count > last:
                bound = row[found[last]]


@kernel(fastmath=FAST, **BORROWS)
def _gradients(
    grad: Any, points: Any, frames: Any, motions: Any, places: Any, scale: Any, nearest: Any, num_workers: int,
    grad_points: Any, grad_motions: Any,
) -> None:  # fmt: skip
    """A worker has every n-th frame: what is added to a motion comes from one thread, in the order of the points."""
    for worker in prange(num_workers):
        for i in range(points.shape[0]):
            if frames[i] % num_workers == worker:
                _one(
                    grad[i], points[i], motions[frames[i]], places[frames[i]], scale, nearest[i],
                    grad_points[i], grad_motions[frames[i]],
                )  # fmt: skip


@njit(fastmath=FAST, **BORROWS)
def _one(
    grad: Any, point: Any, motion: Any, place: Any, scale: Any, found: Any, grad_point: Any, grad_motion: Any
) -> None:
    """Gradients of one point's displacement, the mean of its nodes' with heights that depend on all their distances."""
    real = point.dtype.type
    least = _square(point, place, found[0])
    end = math.exp((least - _square(point, place, found[NEAREST])) * scale)
    total, mean = real(0), real(0)  # of weights; of how far the displacements go along the gradient
    for j in range(NEAREST):
        weight = math.exp((least - _square(point, place, found[j])) * scale) - end + real(LEAST_WEIGHT)
        total += weight
        mean += weight * _along(grad, point, motion, place, found[j])
    mean /= total
    for axis in range(3):
        grad_point[axis] = real(0)
    by_least, by_end = real(0), real(0)  # gradients of the first and of the last node's squared distance
    for j in range(NEAREST):
        k = found[j]
        height = math.exp((least - _square(point, place, k)) * scale)
        by_height = (_along(grad, point, motion, place, k) - mean) / total
        by_least += scale * (height - end) * by_height
        by_end += scale * end * by_height
        _pull(point, place, k, -scale * height * by_height, grad_point, grad_motion)
        _carry(grad, (height - end + real(LEAST_WEIGHT)) / total, point, motion, place, k, grad_point, grad_motion)
    _pull(point, place, found[0], by_least, grad_point, grad_motion)
    _pull(point, place, found[NEAREST], by_end, grad_point, grad_motion)


@njit(fastmath=FAST, **BORROWS)
def _away(point: Any, place: Any, k: int) -> Any:
    """From a node to a point."""
    return point[0] - place[0, k], point[1] - place[1, k], point[2] - place[2, k]


@njit(fastmath=FAST, **BORROWS)
def _square(point: Any, place: Any, k: int) -> Any:
    u, v, w = _away(point, place, k)
    return u * u + v * v + w * w


@njit(fastmath=FAST, **BORROWS)
def _cross(a: Any, b: Any) -> Any:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(fastmath=FAST, **BORROWS)
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(fastmath=FAST, **BORROWS)
def _moved(point: Any, motion: Any, place: Any, k: int) -> Any:
    """A point's displacement by one node."""
    axis = motion[k, 0], motion[k, 1], motion[k, 2]
    half = 2 / (1 + _dot(axis, axis))
    once = _cross(axis, _away(point, place, k))
    twice = _cross(axis, once)
    return (
        half * (twice[0] - once[0]) - motion[k, 3], half * (twice[1] - once[1]) - motion[k, 4],
        half * (twice[2] - once[2]) - motion[k, 5],
    )  # fmt: skip


@njit(fastmath=FAST, **BORROWS)
def _along(grad: Any, point: Any, motion: Any, place: Any, k: int) -> Any:
    return _dot(grad, _moved(point, motion, place, k))


@njit(fastmath=FAST, **BORROWS)
def _pull(point: Any, place: Any, k: int, by_square: Any, grad_point: Any, grad_motion: Any) -> None:
    """Gradients of the squared distance to a node."""
    away = _away(point, place, k)
    for axis in range(3):
        grad_point[axis] += 2 * by_square * away[axis]
        grad_motion[k, 3 + axis] -= 2 * by_square * away[axis]


@njit(fastmath=FAST, **BORROWS)
def _carry(
    grad: Any, weight: Any, point: Any, motion: Any, place: Any, k: int, grad_point: Any, grad_motion: Any
) -> None:
    """Gradients of one node's displacement h (a x (a x y) - a x y) - v with h = 2 / (1 + a.a), times its weight."""
    g = weight * grad[0], weight * grad[1], weight * grad[2]
    axis, away = (motion[k, 0], motion[k, 1], motion[k, 2]), _away(point, place, k)
    half = 2 / (1 + _dot(axis, axis))
    once = _cross(axis, g)
    twice = _cross(axis, once)
    beside = _cross(away, g)
    both, to_axis, to_away = _dot(g, away), _dot(g, axis), _dot(axis, away)
    turned = half * (to_axis * to_away - both * _dot(axis, axis) - _dot(axis, beside))
    for i in range(3):
        to_point = half * (once[i] + twice[i])
        grad_point[i] += to_point
        grad_motion[k, 3 + i] -= to_point + g[i]
        product = g[i] * to_away + away[i] * to_axis - 2 * axis[i] * both - beside[i]
        grad_motion[k, i] += half * (product - turned * axis[i])
