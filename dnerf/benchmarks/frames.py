"""What a frame of a finished model takes, alone and in a sequence, and how near it comes to the truth."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dnerf.benchmarks.scenes import train_model
from dnerf.benchmarks.suite import Plot, Series, Settings, SuiteResult, Table
from dnerf.benchmarks.timing import time_in_turn
from dnerf.cameras import Intrinsics
from dnerf.data.frames import Frames
from dnerf.evaluation import spread_indices
from dnerf.metrics import psnr
from dnerf.renderer import FRAMES_THAT_SHARE, Renderer
from dnerf.samplers import OccupancySampler, Sampler

ALONE, SHARED = "one frame", "in a sequence"


def run(settings: Settings) -> SuiteResult:
    """Render the same frames of every model in all ways, in turn."""
    scales = [1] if settings.quick else settings.options["scales"]
    rows = [
        row for name, parts in _models(settings) for scale in scales for row in _measure(name, parts, settings, scale)
    ]
    return SuiteResult(
        title="Milliseconds of a frame",
        summary=(
            "Frames of a split, spread evenly, rendered in evaluation mode, one after the other, and compared with the "
            f"true pictures. `{ALONE}`: nothing is kept from frame to frame. `{SHARED}`: what frames share (canonical "
            "space in bricks) is kept, as `render.py` does for long films, and was computed before the clock starts; "
            "left out where haze forbids it, where a kernel asks the field itself as quickly, or where a GPU replays "
            "frames as graphs. "
            "`splits`: parts of a step in which something is seen "
            "(`sampler.render_splits`; the run's own comes first). Larger pictures "
            "than the data's are shown, not compared. All ways of a model are timed in turn."
        ),
        tables=[Table("Frames", rows, "PSNR in dB, mean over the frames; medians and quartiles of their mean time.")],
        plots=[_plot(rows)],
        findings=_findings(rows),
    )


def _models(settings: Settings) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Finished runs by name, or a model that is trained now if there are none."""
    options = settings.options
    for folder in options["runs"]:
        yield Path(folder).name, settings.finished(folder)
    if not options["runs"]:
        yield options["scene"], train_model(settings)


def _measure(name: str, parts: Mapping[str, Any], settings: Settings, scale: float) -> list[dict[str, Any]]:
    options = settings.options
    renderer: Renderer = parts["renderer"].to(settings.device).eval()
    frames: Frames = parts["data"].frames(options["split"]).to(settings.device)
    chosen = spread_indices(len(frames), 1 if settings.quick else options["num_frames"])
    count, camera = len(chosen), frames.intrinsics
    shown = camera.resized(round(camera.width * scale), round(camera.height * scale))
    background = renderer.background(torch.zeros(1, 3, device=settings.device))[0]
    truths = [frames.image(i, background) for i in chosen]
    calls = {
        way: partial(_pictures, model, way[1], frames, chosen, shown, parts["chunk"])
        for way, model in _ways(renderer, [] if settings.quick else options["splits"])
    }
    scores = {way: _score(call(), truths) for way, call in calls.items()}
    timings = time_in_turn(
        {str(way): call for way, call in calls.items()},
        seconds=0.1, min_repeats=1 if settings.quick else options["repeats"], device=settings.device,
    )  # fmt: skip
    size = f"{shown.width} x {shown.height}"
    return [
        {
            "run": name,
            "size": size,
            "shown": way[0],
            "splits": way[1],
            "psnr": scores[way],
            **{column: value / count for column, value in timings[str(way)].milliseconds.items()},
            "frames_per_second": count / timings[str(way)].median,
        }
        for way in calls
    ]


def _score(pictures: list[Tensor], truths: list[Tensor]) -> float | None:
    """Mean PSNR in dB; None for pictures of another size."""
    if pictures[0].shape != truths[0].shape:
        return None
    scores = [float(psnr(picture.clamp(0, 1), truth)) for picture, truth in zip(pictures, truths, strict=True)]
    return sum(scores) / len(scores)


def _ways(renderer: Renderer, splits: list[int]) -> Iterator[tuple[tuple[str, int | None], Renderer]]:
    """The model's ways to show a frame: alone and sharing, with its own parts of a step and with others."""
    shared = renderer.for_sequence(FRAMES_THAT_SHARE)
    own = renderer.sampler.render_splits if isinstance(renderer.sampler, OccupancySampler) else None
    others = [] if own is None else [value for value in splits if value != own]
    for shown, model in ((ALONE, renderer),) if shared is renderer else ((ALONE, renderer), (SHARED, shared)):
        for value in (own, *others):
            yield (shown, value), model


def _pictures(
    renderer: Renderer, splits: int | None, frames: Frames, chosen: list[int], shown: Intrinsics, chunk: int
) -> list[Tensor]:
    cameras = [replace(frames.camera(i), intrinsics=shown) for i in chosen]
    times = [float(frames.times[i]) for i in chosen]
    with _cutting(renderer.sampler, splits):
        return [
            renderer.render_image(camera, time, chunk=chunk).rgb for camera, time in zip(cameras, times, strict=True)
        ]


@contextmanager
def _cutting(sampler: Sampler, splits: int | None) -> Iterator[None]:
    """Meanwhile cut the steps in which something is seen into so many: the ways to show a frame share a sampler."""
    if splits is None or not isinstance(sampler, OccupancySampler):
        yield
        return
    own, sampler.render_splits = sampler.render_splits, splits
    try:
        yield
    finally:
        sampler.render_splits = own


def _plot(rows: list[dict[str, Any]]) -> Plot:
    series = []
    rows = [row for row in rows if row["psnr"] is not None]
    for name, shown in dict.fromkeys((row["run"], row["shown"]) for row in rows):
        part = [row for row in rows if (row["run"], row["shown"]) == (name, shown)]
        part.sort(key=lambda row: row["splits"] or 0)
        x, low, high = ([row[column] for row in part] for column in ("median_ms", "low_ms", "high_ms"))
        notes = ["" if row["splits"] is None else str(row["splits"]) for row in part]
        y = [row["psnr"] for row in part]
        series.append(Series(f"{name}, {shown}", x, y, x_low=low, x_high=high, notes=notes))
    return Plot(
        name="frames",
        title="Quality against time of a frame",
        x_label="time per frame (ms)",
        y_label="PSNR (dB)",
        series=series,
        y_log=False,
        note="Up and left is better; numbers are the parts of a step, bars the quartiles of time.",
    )


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    """What every run's own settings take: the first row of each way to show it."""
    own: dict[tuple[str, str, str], dict[str, Any]] = {}
    for row in rows:
        own.setdefault((row["run"], row["shown"], row["size"]), row)
    return [
        f"{name}, {size}, {shown}: {row['median_ms']:.3g} ms [{row['low_ms']:.3g}, {row['high_ms']:.3g}]"
        + ("." if row["psnr"] is None else f", {row['psnr']:.2f} dB.")
        for (name, shown, size), row in own.items()
    ]
