"""Motion that a model has recovered: material points carried between times, tracks, motion vectors of pictures.

Everything here works for an invertible deformation, for any other one through `dnerf.deformations.invert` (a
fixed-point inverse; look at the residuals), and for analytic scenes, whose motion is exact.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.cameras import Camera
from dnerf.checks import check_positive, check_shape
from dnerf.compositing import Rendering
from dnerf.deformations import CarriedDeformation, Deformation, IdentityDeformation, InvertibleDeformation, invert
from dnerf.fields import DeformedField, RadianceField
from dnerf.geometry import check_last_axis
from dnerf.renderer import Renderer
from dnerf.scenes import AnalyticScene

MotionModel = Deformation | AnalyticScene

SOLVED = 1e-4
"""Residual, in world units, below which a fixed-point inverse counts as found."""

NUM_STATIONS = 8
"""Times through which a point is led whose inverse was not found at once."""


def motion_model(field: RadianceField | Renderer) -> MotionModel:
    """What moves matter in a field or renderer: see `DeformedField.motion`; or the scene itself; identity if none."""
    if isinstance(field, Renderer):
        field = field.field
    if isinstance(field, DeformedField):
        return field.motion
    return field if isinstance(field, AnalyticScene) else IdentityDeformation()


@torch.no_grad()
def carry(
    model: MotionModel,
    positions: Tensor,
    start: float | Tensor,
    end: float | Tensor,
    *,
    guess: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Carry material points from one time to another, through canonical space.

    Args:
        model: see `motion_model`.
        positions: (..., 3) in world units, where the points are at `start`.
        start: in [0, 1], a number or (...,).
        end: likewise.
        guess: (..., 3) about where the points are at `end`; only a fixed-point inverse uses it.

    Returns:
        moved: (..., 3) where they are at `end`.
        residual: (...,) distance in canonical space between the points and their images, in world units: how well the
            inverse fits. Zero for analytic scenes; a large one (no inverse was found) means that `moved` is no answer,
            infinity that no matter is there: the home of a carried body that is absent.

    Raises:
        ValueError: for shapes that do not fit.

    Not differentiable, and in the positions' precision also under autocast.
    """
    check_last_axis("positions", positions, 3)
    before, after = (_per_point(t, positions) for t in (start, end))
    with torch.autocast(positions.device.type, enabled=False):
        if isinstance(model, AnalyticScene):
            return model.advect(positions, before, after), torch.zeros_like(before)
        if isinstance(model, CarriedDeformation):
            home = model.bodies(positions, before)
            near = None if guess is None else model.bodies(guess, after)
            moved, residual = carry(model.deformation, home, before, after, guess=near)
            is_nowhere = model.bodies.is_nowhere(home)
            moved = torch.where(is_nowhere[..., None], positions, model.bodies.inverse(moved, after))
            return moved, residual.masked_fill(is_nowhere, torch.inf)
        canonical = model(positions, before)
        if not isinstance(model, InvertibleDeformation):
            guess = positions if guess is None else guess
            return _carry_by_fixed_point(model, canonical, before, after, positions, guess)
        moved = model.inverse(canonical, after)
        residual = (model(moved, after) - canonical).norm(dim=-1)
        left = ~(residual < SOLVED)
        # A flow of few coarse steps may be far from its reverse at a few points.
        found, miss = invert(model, canonical[left], after[left], guess=moved[left], use_jacobian=True)
        return moved.masked_scatter(left[..., None], found), residual.masked_scatter(left, miss)


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
    return times.expand(positions.shape[:-1])


@dataclass(frozen=True)
class Trajectories:
    """Material points at several times.

    Args:
        times: (T,).
        positions: (T, ..., 3) in world units.
        residuals: (T, ...) see `carry`.
    """

    times: Tensor
    positions: Tensor
    residuals: Tensor


def follow(model: MotionModel, positions: Tensor, time: float, times: Tensor) -> Trajectories:
    """Follow material points over all given times.

    Args:
        model: see `motion_model`.
        positions: (..., 3) in world units, where the points are at `time`.
        time: in [0, 1].
        times: (T,) in [0, 1], in any order.

    Times are visited outwards from `time`, so that a fixed-point inverse always starts near its answer.
    """
    check_shape("times", times, ("T",))
    moments = times.tolist()
    found: dict[int, tuple[Tensor, Tensor]] = {}
    forwards = sorted((i for i, t in enumerate(moments) if t >= time), key=lambda i: moments[i])
    backwards = sorted((i for i, t in enumerate(moments) if t < time), key=lambda i: -moments[i])
    for order in (forwards, backwards):
        guess = positions
        for i in order:
            found[i] = carry(model, positions, time, moments[i], guess=guess)
            guess = found[i][0]
    if not found:
        return Trajectories(times, positions[None][:0], positions[None][:0, ..., 0])
    return Trajectories(
        times,
        torch.stack([found[i][0] for i in range(len(moments))]),
        torch.stack([found[i][1] for i in range(len(moments))]),
    )


@dataclass(frozen=True)
class MotionVectors:
    """Where the matter that each pixel of a picture shows is at another time (and in another camera, if given).

    Args:
        flow_2d: (H, W, 2) in pixels, columns to the right and rows down; zero where not `valid`.
        flow_3d: (H, W, 3) in world units; zero where not `valid`.
        positions: (H, W, 3) the points that the pixels show, at the expected depth.
        valid: (H, W) bool, opaque pixels whose matter is in front of the other camera.
        visible: (H, W) bool, valid pixels whose matter lies inside the other picture and, if its depth is known, is
            not hidden there.
        residual: (H, W) see `carry`; zero where not `valid`.
    """

    flow_2d: Tensor
    flow_3d: Tensor
    positions: Tensor
    valid: Tensor
    visible: Tensor
    residual: Tensor


@torch.no_grad()
def motion_vectors(
    model: MotionModel,
    camera: Camera,
    time: float,
    other_time: float,
    depth: Tensor,
    opacity: Tensor,
    *,
    other_camera: Camera | None = None,
    other_depth: Tensor | None = None,
    min_opacity: float = 0.5,
    tolerance: float = 0.05,
    chunk: int = 65536,
) -> MotionVectors:
    """Motion of every pixel of a picture between two times.

    Args:
        model: see `motion_model`.
        camera: of the picture.
        time: of the picture, in [0, 1].
        other_time: where to, in [0, 1].
        depth: (H, W) expected distance along the rays, as in `Rendering.depth`.
        opacity: (H, W).
        other_camera: of the other picture; the same camera if None, and 2-D motion is that of the matter alone.
        other_depth: (H, W) depth of the other picture, to find what is hidden there; None takes nothing as hidden.
        min_opacity: pixels below it show no matter.
        tolerance: distance behind the other picture's surface at which matter counts as hidden, in world units.
        chunk: points at a time.

    Returns:
        `MotionVectors`.

    Raises:
        ValueError: for shapes that do not fit the camera.
    """
    size = (camera.intrinsics.height, camera.intrinsics.width)
    check_shape("depth", depth, size)
    check_shape("opacity", opacity, size)
    check_positive("chunk", chunk)
    other_camera = camera if other_camera is None else other_camera
    rays = camera.rays(time)
    positions = torch.addcmul(rays.origins, depth.reshape(-1, 1), rays.directions)
    indices = (opacity.reshape(-1) >= min_opacity).nonzero()[:, 0]
    parts = [carry(model, positions[some], time, other_time) for some in indices.split(chunk)]
    moved, residual = positions.clone(), torch.zeros_like(positions[:, 0])
    if len(indices):
        moved[indices] = torch.cat([part[0] for part in parts])
        residual[indices] = torch.cat([part[1] for part in parts])
    pixels, other_z = other_camera.project(moved)
    valid = torch.zeros_like(other_z, dtype=torch.bool)
    valid[indices] = other_z[indices] > 0
    pixels = torch.where(valid[:, None], pixels, 0.0)
    flow_2d = torch.where(valid[:, None], pixels - camera.project(positions)[0], 0.0)
    visible = valid & _inside(pixels, other_camera)
    if other_depth is not None:
        check_shape("other_depth", other_depth, (other_camera.intrinsics.height, other_camera.intrinsics.width))
        distance = (moved - other_camera.pose[:3, 3]).norm(dim=-1)
        visible &= distance <= _nearest(other_depth, pixels) + tolerance
    return MotionVectors(
        flow_2d=flow_2d.reshape(*size, 2),
        flow_3d=torch.where(valid[:, None], moved - positions, 0.0).reshape(*size, 3),
        positions=positions.reshape(*size, 3),
        valid=valid.reshape(size),
        visible=visible.reshape(size),
        residual=torch.where(valid, residual, 0.0).reshape(size),
    )


def render_motion(
    renderer: Renderer,
    camera: Camera,
    time: float,
    other_time: float,
    *,
    other_camera: Camera | None = None,
    chunk: int = 16384,
) -> tuple[Rendering, Rendering, MotionVectors]:
    """Render a picture at two times and the motion of the first one's pixels to the second.

    Args:
        renderer: the model.
        camera: of the first picture, on the model's device.
        time: of the first picture, in [0, 1].
        other_time: of the second, in [0, 1].
        other_camera: of the second picture; the same if None.
        chunk: rays at a time.

    Returns:
        The picture, the other picture, and `MotionVectors` with what is hidden in the other left out of `visible`.
    """
    other_camera = camera if other_camera is None else other_camera
    first = renderer.render_image(camera, time, chunk=chunk)
    second = renderer.render_image(other_camera, other_time, chunk=chunk)
    # Rays that meet nothing have depth 0, but hide nothing either.
    other_depth = torch.where(second.opacity < 0.5, torch.inf, second.depth)
    vectors = motion_vectors(
        motion_model(renderer), camera, time, other_time, first.depth, first.opacity,
        other_camera=other_camera, other_depth=other_depth, chunk=chunk,
    )  # fmt: skip
    return first, second, vectors


def _inside(pixels: Tensor, camera: Camera) -> Tensor:
    """Whether points (N, 2) round to a pixel of the picture."""
    limits = torch.tensor([camera.intrinsics.width, camera.intrinsics.height], device=pixels.device)
    return ((pixels >= -0.5) & (pixels < limits - 0.5)).all(-1)


def _nearest(image: Tensor, pixels: Tensor) -> Tensor:
    """Value (N,) of the pixel nearest to each of (N, 2), those outside clamped to the edge."""
    columns = pixels[:, 0].round().clamp(0, image.shape[1] - 1).long()
    rows = pixels[:, 1].round().clamp(0, image.shape[0] - 1).long()
    return image[rows, columns]
