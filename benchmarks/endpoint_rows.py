"""How right recovered motion is: rows of a table."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from dnerf.core.checks import check_positive
from dnerf.data.normalization import Similarity
from dnerf.motion.transport import MotionModel, carry
from dnerf.scenes import AnalyticScene

Row = dict[str, Any]


@torch.no_grad()
def endpoint_rows(
    model: MotionModel, scene: AnalyticScene, *, time: float = 0.0,
    times: Sequence[float] = (0.1, 0.25, 0.5, 0.75, 1.0), num_points: int = 4096, depth: float = 0.05,
    min_motion: float = 0.01, seed: int = 0, similarity: Similarity = Similarity(),  # noqa: B008
) -> list[Row]:  # fmt: skip
    """3-D end-point error of recovered motion: distance from where the scene carries a point.

    Points lie near the surface of exactly one body at both times (joints overlap, and there motion has no single
    truth), at most `depth` below it: images show nothing further inside.

    Args:
        model: recovered motion, see `dnerf.motion.transport`.
        scene: the truth.
        time: where points start, in [0, 1].
        times: where they are followed to.
        num_points: tried; those that qualify count.
        depth: in world units.
        min_motion: points that at none of `times` are so far from where they started are left out, in world units.
        seed: of the points.
        similarity: from the scene's units to the model's.

    Returns:
        Rows of time, num_points, moved (mean distance that points move, the error of a model in which nothing does),
        mean_error, median_error and residual (median, see `carry`), in world units. Times at which no point is in one
        body only are left out.

    Raises:
        ValueError: if nothing moves, or at no time is a point in one body only.
    """
    start = surface_points(scene, time, num_points, depth=depth, seed=seed)
    farthest = torch.stack([(scene.advect(start, time, end) - start).norm(dim=-1) for end in times]).amax(0)
    start = start[farthest > min_motion]
    if not len(start):
        raise ValueError(f"scene must have points that move by {min_motion} between time {time} and {list(times)}")
    rows = []
    for end in times:
        truth = scene.advect(start, time, end)
        end_times = torch.full_like(truth[:, 0], end)
        alone = scene.contains(truth, end_times).sum(-1) == 1
        if not alone.any():
            continue
        points, target = start[alone], truth[alone]
        moved, residual = carry(model, similarity.positions_to_world(points).to(points), time, end)
        errors = (similarity.positions_from_world(moved) - target).norm(dim=-1)
        rows.append({
            "time": end, "num_points": len(points), "moved": float((points - target).norm(dim=-1).mean()),
            "mean_error": float(errors.mean()), "median_error": float(errors.median()),
            "residual": float(residual.median()) / similarity.scale,
        })  # fmt: skip
    if not rows:
        raise ValueError(f"scene must have points that are in one body only at one of the times {list(times)}")
    return rows


def surface_points(scene: AnalyticScene, time: float, num_points: int, *, depth: float, seed: int) -> Tensor:
    """Points (N, 3) in exactly one body and at most about `depth` below its surface; N <= num_points.

    Raises:
        ValueError: if a scene has no such points.
    """
    check_positive("depth", depth)
    generator = torch.Generator(scene.box.device).manual_seed(seed)
    found: list[Tensor] = []
    for _ in range(64):
        unit = torch.rand(16384, 3, generator=generator, device=scene.box.device)
        points = torch.lerp(scene.box[0], scene.box[1], unit)
        shifts = torch.randn(len(points), 3, generator=generator, device=points.device)
        outside = points + depth * torch.nn.functional.normalize(shifts, dim=-1)
        times = torch.full_like(points[:, 0], time)
        kept = (scene.contains(points, times).sum(-1) == 1) & (scene.body_indices(outside, times) < 0)
        found.append(points[kept])
        if sum(len(part) for part in found) >= num_points:
            break
    points = torch.cat(found)[:num_points]
    if not len(points):
        raise ValueError(f"scene must have points within {depth} of its surface at time {time}, found none")
    return points
