"""How close motion is to the true motion: vectors between two frames, and tracks through many."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.checks import check_shape

TRACK_THRESHOLDS = (1.0, 2.0, 4.0, 8.0, 16.0)
TRACK_SIZE = 256


def end_point_error(motion: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Mean Euclidean distance between estimated and true motion vectors; NaN if none counts.

    In two dimensions the end-point error of optical flow (Otte and Nagel 1994; Baker et al. 2007), in pixels; in three
    that of scene flow (EPE3D of Liu et al., "FlowNet3D", CVPR 2019), in world units.

    Args:
        motion: (..., 2) or (..., 3).
        truth: same shape; ValueError otherwise.
        mask: (...,) bool, which count; all if None.
    """
    return float(_lengths(motion, truth, mask)[0].mean())


def flow_outliers(flow: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Share of vectors that are off by more than 3 pixels and by more than 5 % of their true length, or no numbers.

    Source: "Fl" of KITTI (Menze and Geiger, "Object scene flow for autonomous vehicles", CVPR 2015). Arguments are
    those of `end_point_error`, in pixels.
    """
    errors, lengths = _lengths(flow, truth, mask)
    return float((~((errors <= 3) | (errors <= 0.05 * lengths))).double().mean())


@dataclass(frozen=True)
class TrackErrors:
    """Errors of N tracks through T times."""

    mean: float  # distance averaged over all times (but the first) and tracks, in the tracks' unit
    median: float  # median over tracks of each track's mean (MTE of PointOdyssey)
    final: float  # mean distance at the last time
    by_time: tuple[float, ...]  # (T,) mean distance at each time: how error grows along the track
    accuracy: float  # 2-D only, mean over thresholds of the share of visible points within them (TAP-Vid); NaN in 3-D
    num_tracks: int  # N


def track_errors(
    tracks: Tensor, truth: Tensor, visible: Tensor | None = None, *, image_size: int | None = None
) -> TrackErrors:
    """Compare long tracks of points, all starting at the same place at the first time.

    `median` is the median trajectory error of Zheng et al., "PointOdyssey" (ICCV 2023); `accuracy` is delta_avg of
    Doersch et al., "TAP-Vid" (NeurIPS 2022): thresholds 1, 2, 4, 8, 16 pixels of a 256 x 256 image, points hidden at a
    time not counted at it. The first time, where all agree by construction, is left out.

    Args:
        tracks: (T, N, 2) in pixels or (T, N, 3) in world units, T >= 2, N >= 1.
        truth: same shape.
        visible: (T, N) bool, which count; all if None.
        image_size: longer side in pixels of the images of 2-D tracks, for the thresholds.

    Raises:
        ValueError: if shapes do not fit, there is nothing to compare or the images' size is missing.
    """
    if tracks.dim() != 3 or tracks.shape[0] < 2 or not tracks.shape[1] or tracks.shape[2] not in (2, 3):
        raise ValueError(f"tracks must have shape (T >= 2, N >= 1, 2 or 3), got {tuple(tracks.shape)}")
    check_shape("truth", truth, tracks.shape)
    if tracks.shape[2] == 2 and image_size is None:
        raise ValueError("image_size must be given for tracks in pixels, got None")
    if visible is None:
        visible = torch.ones(tracks.shape[:2], dtype=torch.bool, device=tracks.device)
    check_shape("visible", visible, tracks.shape[:2])
    # What does not count may be unknown: zero times NaN is NaN.
    errors = torch.where(visible, (tracks - truth).norm(dim=-1), 0.0).double()[1:]
    counts = visible[1:].double()
    per_track = (errors.sum(0) / counts.sum(0))[counts.sum(0) > 0]
    by_time = (errors.sum(1) / counts.sum(1)).tolist()
    accuracy = torch.nan
    if image_size is not None and tracks.shape[2] == 2:
        scale = image_size / TRACK_SIZE
        shares = [float((counts * (errors < scale * t)).sum() / counts.sum()) for t in TRACK_THRESHOLDS]
        accuracy = sum(shares) / len(shares)
    mean, median = float(errors.sum() / counts.sum()), float(per_track.quantile(0.5)) if len(per_track) else torch.nan
    return TrackErrors(mean, median, by_time[-1], (0.0, *by_time), accuracy, tracks.shape[1])


def _lengths(motion: Tensor, truth: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Distances between vectors and lengths of the true ones, (M,) float64, of those that count."""
    if motion.shape != truth.shape or motion.shape[-1:] not in ((2,), (3,)):
        raise ValueError(
            f"motion and truth must have one shape (..., 2 or 3), got {tuple(motion.shape)} and {tuple(truth.shape)}"
        )
    if mask is not None:
        check_shape("mask", mask, motion.shape[:-1])
        motion, truth = motion[mask], truth[mask]
    return (motion - truth).double().norm(dim=-1).flatten(), truth.double().norm(dim=-1).flatten()
