"""Points carried by the rigid motions of the nodes that are nearest to them at their time."""

from typing import Any

import torch
from torch import Tensor

from .backend import choose
from .checks import check_shapes
from .op import op

NEAREST = 4  # nodes that carry a point; the next one is where their weights end
LEAST_WEIGHT = 1e-4  # of the nearest ones' unnormalised weights: there is a sum to divide by


def blend_rigid(points: Tensor, frames: Tensor, motions: Tensor, nodes: Tensor, radius: float) -> Tensor:
    """Displacements back to where points were while nodes rested, each blended of rigid motions of nearby nodes.

    Node k rests at n_k. In frame f it is at p_k = n_k + v_k, turned by R_k. A point x of that frame is displaced by

        sum_k w_k (R_k^T (x - p_k) + n_k - x),   w_k ~ a_k - a_last,   a_k = exp(-|x - p_k|^2 / (2 radius^2)),

    over its `NEAREST` nodes, with a_last of the next one after these: no weight jumps where the choice changes.
    Weights sum to 1, so that nodes that move as one rigid body carry all points exactly so.

    Args:
        points: (N, 3), differentiable.
        frames: (N,) int64 in [0, F), of each point.
        motions: (F, K, 6), differentiable: Rodrigues's vector of R_k, its axis times the tangent of half its angle,
            then v_k.
        nodes: (K, 3) resting places, K > `NEAREST`.
        radius: of weights, in the points' unit, > 0.

    Returns:
        (N, 3), in the dtype of points. The compiled version is differentiable once.

    Raises:
        ValueError: shapes that do not fit, or too few nodes.
    """
    if nodes.shape[0] <= NEAREST:
        raise ValueError(f"nodes must be at least {NEAREST + 1}, got {nodes.shape[0]}")
    check_shapes(
        points=(points, ("N", 3)), frames=(frames, points.shape[:1]), motions=(motions, ("F", len(nodes), 6)),
        nodes=(nodes, ("K", 3)),
    )  # fmt: skip
    if points.is_cpu and choose(points) == "numba":
        return _blend_rigid(points, frames, motions, nodes, radius)[0]
    return blend_rigid_reference(points, frames, motions, nodes, radius)


def blend_rigid_reference(points: Tensor, frames: Tensor, motions: Tensor, nodes: Tensor, radius: float) -> Tensor:
    """The definition of `blend_rigid` in plain torch."""
    places = nodes + motions[..., 3:]
    with torch.no_grad():
        squares = (points[:, None] - places[frames]).square().sum(-1)
        nearest = squares.topk(NEAREST + 1, dim=-1, largest=False).indices
    away = points[:, None] - places[frames[:, None], nearest]
    squares = away.square().sum(-1)
    heights = torch.exp((squares[:, :1] - squares) / (2 * radius**2))
    weights = heights[:, :NEAREST] - heights[:, NEAREST:] + LEAST_WEIGHT
    weights = weights / weights.sum(-1, keepdim=True)
    chosen = motions[frames[:, None], nearest[:, :NEAREST]]
    axes, travels = chosen[..., :3], chosen[..., 3:]
    moved = turned_back(axes, away[:, :NEAREST]) - travels
    return (weights[..., None] * moved).sum(1)


def turned_back(axes: Tensor, vectors: Tensor) -> Tensor:
    """`R^T y - y` of vectors y (..., 3), R by its Rodrigues's vector (..., 3): exactly zero where that is."""
    once = torch.linalg.cross(axes, vectors)
    twice = torch.linalg.cross(axes, once)
    return 2 / (1 + axes.square().sum(-1, keepdim=True)) * (twice - once)


_blend_rigid_grad = op(
    "blend_rigid_grad(Tensor grad, Tensor points, Tensor frames, Tensor motions, Tensor nodes, float radius, "
    "Tensor nearest) -> (Tensor, Tensor)",
    "blend_rigid.gradients", gradient_of="blend_rigid",
)  # fmt: skip


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    points, frames, motions, nodes, ctx.radius = inputs
    ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(points, frames, motions, nodes, output[1])


def _backward(ctx: Any, grad: Tensor, _: Tensor | None) -> tuple[Tensor | None, ...]:
    points, frames, motions, nodes, nearest = ctx.saved_tensors
    to_points, to_motions = _blend_rigid_grad(grad, points, frames, motions, nodes, ctx.radius, nearest)
    return to_points, None, to_motions, None, None


_blend_rigid = op(
    "blend_rigid(Tensor points, Tensor frames, Tensor motions, Tensor nodes, float radius) -> (Tensor, Tensor)",
    "blend_rigid.displacements", backward=_backward, setup_context=_save,
)  # fmt: skip
