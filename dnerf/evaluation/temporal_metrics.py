"""How steady a film is: along its motion, over time at one pixel, and in depth.

Images are (H, W, C) floats. Motion vectors `flow` (H, W, 2) say for each pixel of the first image how many pixels to
the right and down its surface point lies in the second; `visible` (H, W) says where that point is visible in both.
"""

import torch
from torch import Tensor

from dnerf.core.checks import check_shape
from dnerf.core.geometry import check_last_axis

TOUCHING = 1e-3  # Share of background in an interpolated pixel that is rounding


def sample_image(image: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear interpolation of an image at fractional pixels; beyond the outermost pixels' centres the edge goes on.

    Args:
        image: (H, W, C) or (H, W), from which (..., C) or (...,) are taken.
        pixels: (..., 2) column and row; whole numbers hit pixels. ValueError for another shape or NaN.
    """
    check_last_axis("pixels", pixels, 2)
    if bool(pixels.isnan().any()):
        raise ValueError(f"pixels must be numbers, got {int(pixels.isnan().any(-1).sum())} that are not")
    height, width = image.shape[:2]
    column, row = pixels[..., 0].clamp(0, width - 1), pixels[..., 1].clamp(0, height - 1)
    left, top = column.floor().clamp(max=max(width - 2, 0)), row.floor().clamp(max=max(height - 2, 0))
    u, v = column - left, row - top
    i, j = top.long(), left.long()
    below, right = (i + 1).clamp(max=height - 1), (j + 1).clamp(max=width - 1)
    if image.dim() == 3:
        u, v = u[..., None], v[..., None]
    upper = (1 - u) * image[i, j] + u * image[i, right]
    lower = (1 - u) * image[below, j] + u * image[below, right]
    return (1 - v) * upper + v * lower


def warping_error(first: Tensor, second: Tensor, flow: Tensor, visible: Tensor) -> float:
    """Mean squared difference of each visible pixel and the place in the second image where its point went.

        E = 1 / |V| sum_{p in V} mean_c (second(p + flow(p)) - first(p))^2

    Source: E_warp of Lai et al., "Learning blind video temporal consistency" (ECCV 2018), who sum over channels where
    this is their mean, and estimate flow and occlusion where they may be exact here. Bilinear interpolation blurs: the
    true images have an error too, the floor to compare with.

    Args:
        first: (H, W, C).
        second: same shape.
        flow: (H, W, 2) in pixels; read only where visible.
        visible: (H, W) bool, V; NaN is returned if there is none. ValueError if shapes do not fit.
    """
    _check_warp(first, flow, visible)
    check_shape("second", second, first.shape)
    return float((sample_image(second, _targets(flow, visible)) - first[visible]).square().mean())


def depth_consistency(
    first_depth: Tensor, second_depth: Tensor, flow: Tensor, visible: Tensor, *, second_opaque: Tensor | None = None
) -> float:
    """Mean relative difference between the depth expected of moved points and the depth rendered where they went.

        E = 1 / |V| sum_{p in V} |second_depth(p + flow(p)) - first_depth(p)| / first_depth(p)

    `first_depth` is the distance **after** the motion: of each pixel's moved point from the second camera. With the
    plain first depth it would blame every camera that moves (as the temporal measures of video depth do that warp by
    2-D flow alone, for example OPW of Wang et al. 2022).

    Args:
        first_depth: (H, W) distance of the moved points from the second eye, in world units, > 0 where visible.
        second_depth: (H, W) distance along the rays of the second camera.
        flow: (H, W, 2) in pixels.
        visible: (H, W) bool, V; NaN is returned if no point is left. ValueError if shapes do not fit.
        second_opaque: (H, W) bool, where the second image shows a surface. Points whose interpolation would touch
            background, which has no depth, are left out; none is if this is None.
    """
    check_shape("first_depth", first_depth, ("H", "W"))
    _check_warp(first_depth, flow, visible)
    check_shape("second_depth", second_depth, first_depth.shape)
    targets, expected = _targets(flow, visible), first_depth[visible]
    errors = (sample_image(second_depth, targets) - expected).abs() / expected
    if second_opaque is not None:
        check_shape("second_opaque", second_opaque, first_depth.shape)
        errors = errors[sample_image(second_opaque.to(targets.dtype), targets) > 1 - TOUCHING]
    return float(errors.mean())


def temporal_psnr(predictions: Tensor, truths: Tensor) -> float:
    """PSNR of frame differences in dB: what is wrong with the *change* from frame to frame, blind to constant errors.

        -10 log10 mean ((p_{i+1} - p_i) - (q_{i+1} - q_i))^2,    peak 1

    The mean runs over all pixels, channels and pairs of neighbours. It is the error dtSSD of Erofeev et al.,
    "Perceptually motivated benchmark for video matting" (BMVC 2015), of colours rather than mattes and in decibels;
    +inf if all changes are right.

    Args:
        predictions: (F, H, W, C) frames at even steps of time, F >= 2; clamped to [0, 1] first.
        truths: same shape, in [0, 1]; ValueError otherwise.
    """
    _check_frames(predictions, 2)
    check_shape("truths", truths, predictions.shape)
    error = predictions.float().clamp(0, 1) - truths.float()
    return float(-10 * error.diff(dim=0).square().mean().log10())


def flicker(frames: Tensor) -> float:
    """Root mean square of the second difference in time of frames (F, H, W, C), F >= 3, at a fixed camera.

        sqrt(mean (f_{i+1} - 2 f_i + f_{i-1})^2)

    A constant image and one that fades evenly have none; white noise of deviation s has sqrt(6) s; motion has some of
    its own, so compare with the truth's. Own definition: the discrete acceleration, of which noise is made mostly and
    smooth motion little (its share falls with the square of the time step, away from edges).
    """
    _check_frames(frames, 3)
    return float(frames.float().diff(n=2, dim=0).square().mean().sqrt())


def _targets(flow: Tensor, visible: Tensor) -> Tensor:
    """Where visible pixels went, (V, 2)."""
    rows, columns = visible.nonzero().unbind(-1)
    return torch.stack([columns, rows], dim=-1) + flow[rows, columns]


def _check_warp(first: Tensor, flow: Tensor, visible: Tensor) -> None:
    height, width = first.shape[:2]
    check_shape("flow", flow, (height, width, 2))
    check_shape("visible", visible, (height, width))
    if visible.dtype != torch.bool:
        raise ValueError(f"visible must be bool, got {visible.dtype}")


def _check_frames(frames: Tensor, least: int) -> None:
    check_shape("frames", frames, ("F", "H", "W", "C"))
    if len(frames) < least:
        raise ValueError(f"frames must be at least {least}, got {len(frames)}")
