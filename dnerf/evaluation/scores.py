"""Scores of a renderer on held-out frames."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import fmean, median

import torch
from torch import Tensor

from dnerf.core.checks import check_positive
from dnerf.data.frames import Frames
from dnerf.evaluation.images import psnr, ssim
from dnerf.rendering.renderer import Renderer

GREY = 0.5  # of what does not count, on both sides
MAX_PSNR = 100.0


@dataclass(frozen=True)
class FrameScore:
    """Score of one frame."""

    index: int  # in its split
    time: float  # in [0, 1]
    psnr: float  # in dB, at most `MAX_PSNR` (identical images would be infinite)
    ssim: float  # in [-1, 1]
    lpips: float | None = None  # distance >= 0, or None if it is not measured


@dataclass(frozen=True)
class Evaluation:
    """Scores of a split: means over its frames, and each frame's."""

    split: str  # name of the split
    psnr: float  # mean of the frames' PSNR, in dB
    ssim: float  # mean of the frames' SSIM
    num_frames: int  # number of frames
    seconds_per_frame: float  # median wall-clock seconds to render one; the first may wait for compilation
    frames: Sequence[FrameScore]  # each frame's score
    lpips: float | None = None  # mean of the frames' LPIPS, or None

    def as_dict(self) -> dict[str, object]:
        """Plain values, ready for JSON; what was not measured is left out."""
        values = {name: value for name, value in asdict(self).items() if value is not None}
        values["frames"] = [{k: v for k, v in asdict(frame).items() if v is not None} for frame in self.frames]
        return values


FrameCallback = Callable[[FrameScore, Tensor, Tensor], None]


def evaluate(
    renderer: Renderer, frames: Frames, split: str = "test", *, chunk: int = 16384, max_frames: int | None = None,
    on_frame: FrameCallback | None = None, lpips: Callable[[Tensor, Tensor], float] | None = None,
) -> Evaluation:  # fmt: skip
    """Render frames and compare them with the truth on the renderer's own (evaluation) background.

    Images are compared as floats in [0, 1]: predictions clamped, truths as stored in 8 bits. PSNR is of
    the pixels that count (`Frames.is_known`); in SSIM, LPIPS and what is shown the others are grey.

    Args:
        max_frames: score at most so many, spread evenly over the split; None scores all.
        on_frame: called with score, prediction (H, W, 3) and truth (H, W, 3) of every frame.
        lpips: gives the distance of two images, see `lpips_metric`; None leaves it out.
    """
    device = renderer.device
    frames = frames.to(device)
    background = renderer.plain_background()
    scores, seconds = [], []
    for i in spread_indices(len(frames), max_frames):
        camera, frame_time = frames.camera(i), float(frames.times[i])
        begin = time.perf_counter()
        prediction = renderer.render_image(camera, frame_time, chunk=chunk).rgb.clamp(0, 1)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds.append(time.perf_counter() - begin)
        truth = frames.image(i, background)
        known = frames.known(i)
        if known is not None:
            prediction, truth = (torch.where(known[..., None], image, GREY) for image in (prediction, truth))
        errors = (prediction, truth) if known is None else (prediction[known], truth[known])
        score = FrameScore(i, frame_time, min(psnr(*errors), MAX_PSNR), ssim(prediction, truth))
        if lpips is not None:
            score = replace(score, lpips=lpips(prediction, truth))
        scores.append(score)
        if on_frame is not None:
            on_frame(score, prediction, truth)
    distances = [score.lpips for score in scores if score.lpips is not None]
    means = fmean(score.psnr for score in scores), fmean(score.ssim for score in scores)
    lpips_mean = fmean(distances) if distances else None
    return Evaluation(split, *means, len(scores), median(seconds), scores, lpips_mean)


def scores_by_time(frames: Sequence[FrameScore], end: float) -> dict[str, dict[str, float | int | None]]:
    """Mean scores up to a time ("interpolation") and after it ("extrapolation"), None where there is no frame."""
    groups = {
        "interpolation": [frame for frame in frames if frame.time <= end],
        "extrapolation": [frame for frame in frames if frame.time > end],
    }
    return {
        name: {
            "num_frames": len(group),
            "psnr": fmean(frame.psnr for frame in group) if group else None,
            "ssim": fmean(frame.ssim for frame in group) if group else None,
        }
        for name, group in groups.items()
    }


def spread_indices(count: int, most: int | None) -> list[int]:
    """At most `most` of the indices below `count`, from first to last at even distances; all if None."""
    if most is None or most >= count:
        return list(range(count))
    check_positive("max_frames", most)
    return [round(k * (count - 1) / max(most - 1, 1)) for k in range(most)]
