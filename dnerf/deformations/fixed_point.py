"""The inverse of a deformation that has none of its own, point by point."""

import torch
from torch import Tensor

from dnerf.checks import check_positive, check_shape
from dnerf.deformations.base import Deformation, check_positions_times


@torch.no_grad()
def invert(
    deformation: Deformation,
    canonical: Tensor,
    times: Tensor,
    *,
    guess: Tensor | None = None,
    num_iterations: int = 30,
    max_step: float = 0.5,
) -> tuple[Tensor, Tensor]:
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
        max_step: longest step of one iteration, in world units.

    Returns:
        world: (..., 3).
        residual: (...,) distance |deformation(world, t) - canonical| in world units.

    Raises:
        ValueError: for shapes or numbers that do not fit.

    Not differentiable.
    """
    check_positions_times(canonical, times)
    check_positive("num_iterations", num_iterations)
    check_positive("max_step", max_step)
    x = canonical if guess is None else guess
    check_shape("guess", x, canonical.shape)
    inverse_jacobian = torch.eye(3, dtype=x.dtype, device=x.device).expand(*x.shape, 3)
    error = deformation(x, times) - canonical
    best, residual = x, error.norm(dim=-1)
    for _ in range(num_iterations - 1):
        step = -_apply(inverse_jacobian, error)
        length = step.norm(dim=-1, keepdim=True)
        step = step * (max_step / length.clamp(min=max_step))
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


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Matrices (..., 3, 3) times vectors (..., 3), in full precision under autocast too."""
    return (matrices * vectors[..., None, :]).sum(-1)
