"""The inverse of a deformation that has none of its own, its derivatives, and how it folds space, point by point."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.checks import check_positive, check_shape
from dnerf.deformations.base import Deformation, check_positions_times

MAX_STEP = 0.5  # of one iteration, in world units
MIDDLE = (0.05, 0.95)
CHUNK = 1 << 15  # places whose derivatives are in memory at a time
Map = Callable[[Tensor, Tensor], Tensor]
"""Positions (..., 3) and times (...,) to positions (..., 3): a deformation, or several in a row."""


@torch.no_grad()
def invert(
    deformation: Map, canonical: Tensor, times: Tensor, *, guess: Tensor | None = None, num_iterations: int = 30,
    use_jacobian: bool = False,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """World positions that a deformation carries to given canonical ones, and how well they do.

    The fixed-point iteration x <- x - (deformation(x, t) - canonical) converges where the displacement is a
    contraction. It is accelerated by Broyden's updates of each point's inverse Jacobian (Broyden 1965, "good"
    method, starting at the identity, so that the first step is the plain one; SNARF, arXiv 2104.03953, inverts
    skinning so), and each point keeps its best iterate. A deformation that folds space has several answers or none:
    look at the residual before using a point.

    Args:
        deformation: world -> canonical.
        canonical: (..., 3) in world units.
        times: (...,) in [0, 1].
        guess: (..., 3) where to begin; the canonical positions if None. A track's last position is a good one.
        num_iterations: evaluations of the deformation.
        use_jacobian: begin with the Jacobian at the guess (three backward passes) rather than with the identity:
            converges near an answer however far the map is from the identity.

    Returns:
        world: (..., 3).
        residual: (...,) distance |deformation(world, t) - canonical| in world units.

    Raises:
        ValueError: for shapes or numbers that do not fit.

    Not differentiable.
    """
    check_positions_times(canonical, times)
    check_positive("num_iterations", num_iterations)
    x = canonical if guess is None else guess
    check_shape("guess", x, canonical.shape)
    inverse_jacobian = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape, 3)
    if use_jacobian:
        jacobian = jacobians(deformation, x, times)
        # Damped, for there to be a step where the map is flat.
        damped = jacobian.mT @ jacobian + 1e-6 * inverse_jacobian
        inverse_jacobian = _solved(damped, jacobian.mT)
    error = deformation(x, times) - canonical
    best, residual = x, error.norm(dim=-1)
    for _ in range(num_iterations - 1):
        step = -_apply(inverse_jacobian, error)
        length = step.norm(dim=-1, keepdim=True)
        step = step * (MAX_STEP / length.clamp(min=MAX_STEP))
        x = x + step
        new_error = deformation(x, times) - canonical
        # The rank-one update is skipped where it would divide by nothing.
        along = (step[..., None, :] * inverse_jacobian.mT).sum(-1)
        change = _apply(inverse_jacobian, new_error - error)
        bottom = (along * (new_error - error)).sum(-1)
        safe = bottom.abs() > 1e-3 * step.square().sum(-1) + torch.finfo(x.dtype).tiny
        scale = torch.where(safe, 1 / torch.where(safe, bottom, torch.ones_like(bottom)), torch.zeros_like(bottom))
        inverse_jacobian = inverse_jacobian + ((step - change) * scale[..., None])[..., :, None] * along[..., None, :]
        error = new_error
        distance = error.norm(dim=-1)
        better = distance < residual
        best = torch.where(better[..., None], x, best)
        residual = torch.where(better, distance, residual)
    return best, residual


def attach_gradient(deformation: Map, world: Tensor, canonical: Tensor, times: Tensor) -> Tensor:
    """Give solved world positions the gradient of the exact inverse, by one Newton step from them.

    By the implicit function theorem `x - J^-1 (deformation(x, t) - canonical)`, with x and J = d deformation / dx at
    the solution held fixed, has the inverse's value up to rounding and its first derivatives to canonical positions,
    times and parameters.

    All positions are (..., 3), times (...,). Differentiable once. J must not be singular.
    """
    world = world.detach()
    jacobian = jacobians(deformation, world, times)
    inverse_jacobian = _solved(jacobian, torch.eye(3, dtype=jacobian.dtype, device=jacobian.device).expand_as(jacobian))
    return world - _apply(inverse_jacobian, deformation(world, times) - canonical)


def jacobians(deformation: Map, positions: Tensor, times: Tensor) -> Tensor:
    """Derivatives (..., 3, 3) of canonical positions (rows) to world positions (columns), without gradient."""
    with torch.enable_grad():
        x = positions.detach().clone().requires_grad_()
        moved = deformation(x, times.detach())
        rows = [torch.autograd.grad(moved[..., i].sum(), x, retain_graph=i < 2)[0] for i in range(3)]
    return torch.stack(rows, dim=-2)


@dataclass(frozen=True)
class Folding:
    """What the Jacobian matrices of a deformation say at several places."""

    least_determinant: float  # negative where space folds
    share_folded: float  # of the places, where it is negative
    stretch: tuple[float, float]  # the middle 90 % of the smallest singular value; 1 is rigid, 0 loses a dimension


def folding(deformation: Deformation, positions: Tensor, times: Tensor) -> Folding:
    """Look at the derivatives of canonical positions to world positions.

    Args:
        deformation: world -> canonical.
        positions: (..., 3) at least one, in world units.
        times: (...,) in [0, 1].

    Raises:
        ValueError: for shapes that do not fit, or no position.
    """
    check_positions_times(positions, times)
    if not positions.numel():
        raise ValueError("positions must be at least one, got none")
    parts = zip(positions.reshape(-1, 3).split(CHUNK), times.reshape(-1).split(CHUNK), strict=True)
    found = torch.cat([jacobians(deformation, *part) for part in parts])
    determinants, smallest = torch.linalg.det(found), torch.linalg.svdvals(found)[:, -1].sort().values
    low, high = (float(smallest[round(share * (len(smallest) - 1))]) for share in MIDDLE)
    return Folding(float(determinants.min()), float((determinants < 0).float().mean()), (low, high))


def _solved(matrices: Tensor, right: Tensor) -> Tensor:
    """What times matrices (..., 3, 3) gives the right side; in single precision at least, and rounded then."""
    precise = torch.promote_types(matrices.dtype, torch.float32)
    return torch.linalg.solve(matrices.to(precise), right.to(precise)).to(matrices.dtype)


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Matrices (..., 3, 3) times vectors (..., 3), in full precision under autocast too."""
    return (matrices * vectors[..., None, :]).sum(-1)
