"""Points carried from one time to another by the motion that a model has recovered.

It works for an invertible deformation, for any other one through `dnerf.deformations.invert` (look at the residuals),
and for analytic scenes, whose motion is exact.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.checks import check_shape
from dnerf.core.geometry import check_last_axis
from dnerf.deformations import Deformation, IdentityDeformation, InvertibleDeformation, invert, unwrapped
from dnerf.fields import DeformedField, RadianceField, TimeDependence
from dnerf.rendering.renderer import Renderer
from dnerf.scenes import AnalyticScene

MotionModel = Deformation | AnalyticScene

SOLVED = 1e-4  # Residual, in world units, below which a fixed-point inverse counts as found
NUM_STATIONS = 8  # Times through which a point is led whose inverse was not found at once


def motion_model(model: RadianceField | Renderer) -> MotionModel | None:
    """What moves the geometry of a field or renderer: its deformation, or the exact scene itself.

    A field that says that it is static (`TimeDependence`) stands still: the identity. A field that changes with time
    without a deformation, or does not say, has an unknown motion: None.
    """
    field = model.field if isinstance(model, Renderer) else model
    if isinstance(field, AnalyticScene):
        return field
    canonical = field
    if isinstance(field, DeformedField):
        deformation, canonical = unwrapped(field.deformation), field.canonical
        if not deformation.is_identity:
            return deformation
    if isinstance(canonical, AnalyticScene):  # seen through the identity: it moves by itself
        return canonical
    is_static = isinstance(canonical, TimeDependence) and canonical.is_static
    return IdentityDeformation() if is_static else None


@torch.no_grad()
def carry(
    model: MotionModel, positions: Tensor, start: float | Tensor, end: float | Tensor, *, guess: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Carry points from one time to another, through canonical space.

    Not differentiable, and in the positions' precision also under autocast. It may be called in inference mode.

    Args:
        model: see `motion_model`; ValueError for an unknown motion.
        positions: (..., 3) in world units, where the points are at `start`.
        start: in [0, 1], a number or (...,).
        end: likewise.
        guess: (..., 3) about where the points are at `end`; only a fixed-point inverse uses it.

    Returns:
        moved: (..., 3) where they are at `end`.
        residual: (...,) distance in canonical space between the points and their images, in world units: how well the
            inverse fits. Zero for analytic scenes; a large one (no inverse was found) means that `moved` is no answer.
    """
    if model is None:
        raise ValueError("model must be a deformation or an exact scene, got None: the motion of this field is unknown")
    check_last_axis("positions", positions, 3)
    # Inverses take derivatives, which need tensors that inference mode has not made; leaving it turns gradients on.
    with torch.inference_mode(False), torch.no_grad(), torch.autocast(positions.device.type, enabled=False):
        positions = positions.clone()
        before, after = (_per_point(t, positions) for t in (start, end))
        if isinstance(model, AnalyticScene):
            return model.advect(positions, before, after), torch.zeros_like(before)
        canonical = model(positions, before)
        if not isinstance(model, InvertibleDeformation):
            guess = positions if guess is None else guess.clone()
            return _carry_by_fixed_point(model, canonical, before, after, positions, guess)
        moved = model.inverse(canonical, after)
        residual = (model(moved, after) - canonical).norm(dim=-1)
        left = ~(residual < SOLVED)
        # A flow of few coarse steps may be far from its reverse at a few points.
        found, miss = invert(model, canonical[left], after[left], guess=moved[left], use_jacobian=True)
        return moved.masked_scatter(left[..., None], found), residual.masked_scatter(left, miss)


@dataclass(frozen=True)
class Tracks:
    """Points at T times."""

    times: Tensor  # (T,)
    positions: Tensor  # (T, ..., 3) in world units
    residuals: Tensor  # (T, ...) see `carry`


def follow(model: MotionModel, positions: Tensor, time: float, times: Tensor) -> Tracks:
    """Follow points over all given times.

    Times are visited outwards from `time`, so that a fixed-point inverse always starts near its answer.

    Args:
        model: see `motion_model`; ValueError for an unknown motion.
        positions: (..., 3) in world units, where the points are at `time`.
        time: in [0, 1].
        times: (T,) in [0, 1], in any order.
    """
    check_shape("times", times, ("T",))
    values = times.tolist()
    found: dict[int, tuple[Tensor, Tensor]] = {}
    guesses = {True: positions, False: positions}  # later, and earlier
    for i in sorted(range(len(values)), key=lambda i: abs(values[i] - time)):
        is_later = values[i] >= time
        found[i] = carry(model, positions, time, values[i], guess=guesses[is_later])
        guesses[is_later] = found[i][0]
    if not found:
        return Tracks(times, positions[None][:0], positions[None][:0, ..., 0])
    return Tracks(times, *(torch.stack([found[i][k] for i in range(len(values))]) for k in (0, 1)))


def _carry_by_fixed_point(
    model: Deformation, canonical: Tensor, start: Tensor, end: Tensor, positions: Tensor, guess: Tensor
) -> tuple[Tensor, Tensor]:
    """Invert from the guess; points that do not arrive are led from where they were, through times in between."""
    world, residual = invert(model, canonical, end, guess=guess)
    left = ~(residual < SOLVED)
    target, before, after, x = canonical[left], start[left], end[left], positions[left]
    miss = residual[left]
    for k in range(1, NUM_STATIONS + 1):
        x, miss = invert(model, target, torch.lerp(before, after, k / NUM_STATIONS), guess=x, use_jacobian=True)
    better = miss < residual[left]
    world = world.masked_scatter(left[..., None], torch.where(better[:, None], x, world[left]))
    return world, residual.masked_scatter(left, torch.where(better, miss, residual[left]))


def _per_point(time: float | Tensor, positions: Tensor) -> Tensor:
    times = torch.as_tensor(time, dtype=positions.dtype, device=positions.device)
    if times.dim():
        check_shape("times", times, positions.shape[:-1])
    return times.clone().expand(positions.shape[:-1])
