"""When matter is most spread out, told from how much of the pictures it covers."""

import math
from itertools import combinations_with_replacement
from typing import NamedTuple

import torch
from torch import Tensor

from dnerf.data.frames import Frames
from dnerf.time_window import MIDDLE

ABOUT_ALL = 0.9  # of the largest area
CERTAIN = 3.0  # standard errors by which a moment must cover less than another one to be told from it
NUM_WAVES = 7  # cosines over time that areas follow
DEGREE = 4  # of the polynomial in the viewing direction that they follow, too: opposite views see the same outline
LEAST_FRAMES = 40  # from which so many numbers are told


class Areas(NamedTuple):
    """Areas of silhouettes over time, as shares of their mean, for the average view.

    Args:
        times: (T,) evenly spread over those of the frames.
        areas: (T,).
        errors: (T,) standard errors of how much less a moment covers than the one that covers most.
    """

    times: Tensor
    areas: Tensor
    errors: Tensor


def most_shown_time(frames: Frames) -> float:
    """The time nearest to the middle of the film at which matter covers about as much as it ever does.

    A convex body's silhouettes, averaged over all views, cover a quarter of its surface (Cauchy 1832), so that parts
    which meet, merge or lie behind each other cover less than when they are apart. The middle is nearest to all other
    times; it is left only for a time at which it is plain that silhouettes are larger by a tenth.

    Args:
        frames: F pictures from different places.

    Returns:
        A time in [0, 1]; the middle for frames without alpha, for fewer than `LEAST_FRAMES`, or of one time.
    """
    found = silhouette_areas(frames)
    if found is None:
        return MIDDLE
    times, areas, errors = found
    missing = areas.max() - areas
    serves = (areas >= ABOUT_ALL * areas.max()) | (missing <= CERTAIN * errors)
    distances = torch.where(serves, (times - MIDDLE).abs(), math.inf)
    return float(times[distances.argmin()])


@torch.no_grad()
def silhouette_areas(frames: Frames, num_times: int = 101) -> Areas | None:
    """How much silhouettes cover over time, for the average view: a regression on time and viewing direction.

    Args:
        frames: F pictures.
        num_times: at which areas are told, over the frames' times.

    Returns:
        The areas; None where they cannot be told: without alpha, of too few frames or of one time, or if all are empty.
    """
    times = frames.times.double().cpu()
    if not frames.has_alpha or len(times) < LEAST_FRAMES or float(times.max() - times.min()) < 1e-6:
        return None
    covered = torch.stack([frames.alpha(i).mean() for i in range(len(times))]).double().cpu()
    distances, directions = _views(frames.poses.double().cpu())
    covered = covered * distances.square()
    if not float(covered.mean()) > 0:
        return None
    covered = covered / covered.mean()
    views = torch.stack([directions[:, list(axes)].prod(-1) for axes in _products()], dim=-1)
    columns = torch.cat([_waves(times), views - views.mean(0)], dim=-1)
    prices = torch.cat([1e-2 * torch.arange(NUM_WAVES).double().square(), torch.full((views.shape[1],), 1e-2)])
    inverse = torch.linalg.inv(columns.mT @ columns + prices.diag())
    weights = inverse @ columns.mT @ covered
    free = len(covered) - float(torch.trace(columns @ inverse @ columns.mT))
    variance = (covered - columns @ weights).square().sum() / free
    spread = (variance * inverse @ (columns.mT @ columns) @ inverse)[:NUM_WAVES, :NUM_WAVES]
    asked = torch.linspace(float(times.min()), float(times.max()), num_times, dtype=torch.float64)
    waves = _waves(asked)
    areas = waves @ weights[:NUM_WAVES]
    apart = waves - waves[areas.argmax()]
    return Areas(asked, areas, ((apart @ spread) * apart).sum(-1).clamp(min=0).sqrt())


def _waves(times: Tensor) -> Tensor:
    return torch.cos(math.pi * torch.arange(NUM_WAVES, dtype=times.dtype) * times[:, None])


def _products() -> list[tuple[int, ...]]:
    return list(combinations_with_replacement(range(3), DEGREE))


def _views(poses: Tensor) -> tuple[Tensor, Tensor]:
    """How far cameras (F, 4, 4) are from the place that is nearest to all their axes, and in which directions."""
    eyes, axes = poses[:, :3, 3], -poses[:, :3, 2]
    across = torch.eye(3, dtype=poses.dtype) - axes[:, :, None] * axes[:, None, :]
    # Parallel axes meet nowhere: of all places that are as near, the one nearest to the world's origin.
    center = torch.linalg.pinv(across.sum(0), rtol=1e-6) @ (across @ eyes[:, :, None]).sum(0)[:, 0]
    away = eyes - center
    distances = away.norm(dim=-1)
    return distances, away / distances.clamp(min=1e-9)[:, None]
