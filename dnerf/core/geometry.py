"""Rays against boxes, rotations and rigid motions, each safe in value and gradient at its bad point."""

from collections.abc import Sequence

import torch
from torch import Tensor

from dnerf.core.checks import as_box, check_shape

# Least distance of planes, in world units: a box behind the camera leaves an empty film, not an error.
MIN_DEPTH = 1e-3


def ray_box(origins: Tensor, directions: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """Distances at which lines enter and leave an axis-aligned box (slab method).

    A line that misses has `enter > leave`. A line along an axis, or lying in a face, is handled exactly: a zero
    direction component gives (-inf, inf) inside the slab, its faces included, and (inf, -inf) outside. Gradients are
    those of the faces that are met; a face that is met only after some 1e15 units (in float32) has none.

    Args:
        origins: (R, 3) in world units.
        directions: (R, 3).
        box: (2, 3) lowest and highest corner.

    Returns:
        enter, leave: (R,) each, in units of the direction's length; `enter` is negative for origins inside.
    """
    check_shape("box", box, (2, 3))
    low, high = box[0] - origins, box[1] - origins
    parallel = directions == 0
    safe = torch.where(parallel, torch.ones_like(directions), directions)
    # Squares of such components leave the range of numbers, and gradients of quotients by them with it.
    faint = directions.detach().abs() < 1e4 * torch.finfo(directions.dtype).tiny ** 0.5
    held_low, held_high, held = (torch.where(faint, x.detach(), x) for x in (low, high, safe))
    first, second = held_low / held, held_high / held
    inside = (low <= 0) & (high >= 0)
    infinity = torch.full_like(first, torch.inf)
    unbounded = torch.where(inside, -infinity, infinity)
    enter = torch.where(parallel, unbounded, torch.minimum(first, second)).amax(-1)
    leave = torch.where(parallel, -unbounded, torch.maximum(first, second)).amin(-1)
    return enter, leave


def clip_to_box(origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """Shorten [near, far] to its part inside a box; rays without one get the empty interval far = near.

    Args and Returns as `ray_box`; near and far are (R,) and finite, so are the results.
    """
    enter, leave = ray_box(origins, directions, box)
    start, end = torch.maximum(near, enter), torch.minimum(far, leave)
    hits = end > start
    return torch.where(hits, start, near), torch.where(hits, end, near)


def skew(vectors: Tensor) -> Tensor:
    """Cross-product matrices: (..., 3) -> (..., 3, 3) with `skew(a) @ b = a x b`."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    rows = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    return rows.reshape(*vectors.shape[:-1], 3, 3)


def _outer_minus_square(vectors: Tensor) -> Tensor:
    """Squares of cross-product matrices: (..., 3) -> (..., 3, 3), `v v^T - |v|^2 I`.

    Without a matrix product, which autocast would run in bfloat16 and some GPUs in tf32.
    """
    eye = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    squared = (vectors * vectors).sum(-1)[..., None, None]
    return vectors[..., :, None] * vectors[..., None, :] - squared * eye


def _rotation_coefficients(rotation_vectors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 of the angle a, smooth at zero; shape (..., 1, 1) each.

    The closed forms lose half their digits to cancellation well before a = 0, so the Taylor branch begins at
    a^2 = 0.25, where eight terms are exact to float64 rounding.
    """
    squared = (rotation_vectors * rotation_vectors).sum(-1)[..., None, None]
    small = squared < 0.25
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    closed = (
        torch.sin(angle) / angle, 2 * (torch.sin(0.5 * angle) / angle) ** 2, (angle - torch.sin(angle)) / angle**3,
    )  # fmt: skip
    near_zero = torch.where(small, squared, torch.zeros_like(squared))
    results = []
    for first, exact in zip((1, 2, 3), closed):
        term = torch.ones_like(near_zero) / (1, 1, 2, 6)[first]
        series = term
        for k in range(1, 9):
            term = -term * near_zero / ((2 * k + first - 1) * (2 * k + first))
            series = series + term
        results.append(torch.where(small, series, exact))
    return results[0], results[1], results[2]


def so3_exp(rotation_vectors: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3), for column vectors, of rotation vectors (..., 3), axis times angle in radians.

    Rodrigues's formula, smooth in value and gradient at zero.
    """
    check_last_axis("rotation_vectors", rotation_vectors, 3)
    a, b, _ = _rotation_coefficients(rotation_vectors)
    cross = skew(rotation_vectors)
    eye = torch.eye(3, dtype=cross.dtype, device=cross.device)
    return eye + a * cross + b * _outer_minus_square(rotation_vectors)


def move_by_twists(twists: Tensor, points: Tensor) -> Tensor:
    """Points (..., 3) carried by rigid motions (Murray, Li, Sastry 1994, eq. 2.36), smooth where these are small.

    Twists are (..., 6): a rotation vector in radians, then a translational velocity in world units.
    """
    check_last_axis("twists", twists, 6)
    turning, travelling = twists[..., :3], twists[..., 3:]
    a, b, c = (x[..., 0] for x in _rotation_coefficients(turning))

    def turned(first: Tensor, second: Tensor, vectors: Tensor) -> Tensor:
        once = torch.linalg.cross(turning, vectors)
        return first * once + second * torch.linalg.cross(turning, once)

    return points + turned(a, b, points) + travelling + turned(b, c, travelling)


def safe_normalize(vectors: Tensor) -> Tensor:
    """Unit vectors (..., 3); a zero vector stays zero with zero gradient."""
    # Scaled first, since squares of float32 lengths below 1e-19 or above 1e19 leave its range.
    largest = vectors.detach().abs().amax(-1, keepdim=True)
    zero = largest == 0
    scaled = vectors / torch.where(zero, torch.ones_like(largest), largest)
    squared = (scaled * scaled).sum(-1, keepdim=True)
    unit = scaled * torch.where(zero, torch.ones_like(squared), squared).rsqrt()
    return torch.where(zero, torch.zeros_like(vectors), unit)


def check_last_axis(name: str, value: Tensor, size: int) -> None:
    """Raise unless the last axis of `value` has the given size."""
    if value.dim() == 0 or value.shape[-1] != size:
        raise ValueError(f"{name} must have shape (..., {size}), got {tuple(value.shape)}")


def cube_corners(device: torch.device) -> Tensor:
    """The corners (8, 3) of the unit cube, int64, z fastest."""
    return torch.cartesian_prod(*[torch.arange(2, device=device)] * 3)


def cubes(box: Tensor, resolution: int) -> list[int]:
    """How many cells a box (2, 3) has on each axis, if they are nearly cubes and so many lie along its longest side."""
    sides = box[1] - box[0]
    return [max(1, round(resolution * float(side / sides.max()))) for side in sides]


def in_unit_cube(positions: Tensor, low: Tensor, scale: Tensor) -> Tensor:
    """Places (N, 3) of positions (..., 3) in a box, whose corners are 0 and 1, by its low one and 1 / its sides."""
    return (positions - low.to(positions.dtype)).mul_(scale.to(positions.dtype)).reshape(-1, 3)


def box_planes(poses: Tensor, box: Sequence[Sequence[float]] | Tensor) -> list[tuple[float, float]]:
    """Near and far z-depths between which cameras (F, 4, 4) have a whole box (2, 3): F pairs 0 <= near < far.

    Planes follow from where a camera is. Near is 0 where the camera is within the box's depths.
    """
    check_shape("poses", poses, ("F", 4, 4))
    corners = as_box(box).to(poses)
    places = torch.lerp(corners[0], corners[1], cube_corners(poses.device).to(poses.dtype))
    offsets = places - poses[:, None, :3, 3]
    depths = -(offsets * poses[:, None, :3, 2]).sum(-1)
    nearest, farthest = depths.amin(-1).clamp(min=0).tolist(), depths.amax(-1).clamp(min=MIN_DEPTH).tolist()
    return list(zip(nearest, farthest))


def distinct_places(places: Tensor, tolerance: float, most: int) -> Tensor:
    """One of each group of places (F, 3) closer than a tolerance to each other; no more than `most` and one."""
    found = places[:1]
    while len(found) <= most:
        distances = torch.cdist(places, found).amin(1)
        if float(distances.max()) <= tolerance:
            break
        found = torch.cat([found, places[distances.argmax()][None]])
    return found
