"""What a frame of a finished model takes, in several ways, and how near it comes to the truth."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from benchmarks.runs import model_mib, run_training
from benchmarks.scenes import scene_overrides
from benchmarks.suite import Plot, Series, Settings, SuiteResult, Table
from benchmarks.timing import Timing, time_in_turn
from dnerf.core.cameras import Intrinsics
from dnerf.data.frames import Frames
from dnerf.evaluation import psnr
from dnerf.evaluation.scores import spread_indices
from dnerf.rendering.renderer import Renderer

OWN = "as trained"


def run(settings: Settings) -> SuiteResult:
    """Render the same frames of every model in all ways, in turn."""
    scales = [1] if settings.quick else settings.options["scales"]
    ways = {OWN: [], **({} if settings.quick else settings.options["ways"])}
    rows = []
    for folder in _runs(settings):
        models = {way: settings.finished(str(folder), changes) for way, changes in ways.items()}
        for scale in scales:
            rows += [
                {"run": folder.name, **row, "model_MiB": model_mib(folder)} for row in _measure(models, settings, scale)
            ]
    return SuiteResult(
        title="Milliseconds of a frame",
        summary=(
            "Frames of a split, spread evenly, rendered in evaluation mode, one after the other, nothing kept from "
            f"frame to frame, and compared with the true images. `{OWN}`: with the run's own settings. Other ways: "
            + "; ".join(f"`{way}`: `{' '.join(changes)}`" for way, changes in ways.items() if changes)
            + ". Images larger than the data's are timed, not compared. All ways of a model are timed in turn."
        ),
        tables=[
            Table(
                "Frames",
                rows,
                "psnr: in dB, mean over the frames. to_own: PSNR to the images of the run's own settings. Times are "
                "medians and quartiles of the frames' mean. model_MiB: size of the weights file.",
            )
        ],
        plots=[_plot(rows)],
        findings=_findings(rows),
    )


def _runs(settings: Settings) -> Iterator[Path]:
    """Folders of finished runs; of one that is trained now, if none is given."""
    options = settings.options
    yield from (Path(folder) for folder in options["runs"])
    if not options["runs"]:
        folder = settings.work_dir / options["scene"]
        size, seconds = (48, 5) if settings.quick else (options["resolution"], options["train_seconds"])
        overrides = [
            f"experiment={options['experiment']}", f"trainer.max_seconds={seconds}", "evaluate_frames=1",
            *scene_overrides(options["scene"], size, options["data_root"], settings.quick),
            f"seed={settings.seed}", f"device={settings.device}",
        ]  # fmt: skip
        run_training(settings.train_command, overrides, folder)
        yield folder


def _measure(models: Mapping[str, Mapping[str, Any]], settings: Settings, scale: float) -> list[dict[str, Any]]:
    options = settings.options
    frames: Frames = models[OWN]["data"].frames(options["split"]).to(settings.device)
    chosen = spread_indices(len(frames), 1 if settings.quick else options["num_frames"])
    camera = frames.intrinsics[0]
    size = camera if scale == 1 else camera.resized(round(camera.width * scale), round(camera.height * scale))
    renderers: dict[str, Renderer] = {way: parts["renderer"].to(settings.device) for way, parts in models.items()}
    background = renderers[OWN].plain_background()
    truths = None if size is not camera else [frames.image(i, background) for i in chosen]
    calls = {
        way: partial(_images, renderer, frames, chosen, size, models[way]["chunk"])
        for way, renderer in renderers.items()
    }
    images = {way: call() for way, call in calls.items()}
    timings = time_in_turn(
        calls, seconds=0.1, min_repeats=1 if settings.quick else options["repeats"], device=settings.device
    )
    return [
        {
            "size": f"{size.width} x {size.height}",
            "way": way,
            "psnr": None if truths is None else _score(images[way], truths),
            "to_own": None if way == OWN else _score(images[way], images[OWN]),
            **_of_one(timings[way], len(chosen)),
        }
        for way in calls
    ]


def _of_one(timing: Timing, count: int) -> dict[str, float]:
    return {**timing.of_each(count).milliseconds, "frames_per_second": count / timing.median}


def _images(renderer: Renderer, frames: Frames, chosen: list[int], size: Intrinsics, chunk: int) -> list[Tensor]:
    return [
        renderer.render_image(replace(frames.camera(i), intrinsics=size), float(frames.times[i]), chunk=chunk).rgb
        for i in chosen
    ]


def _score(images: Sequence[Tensor], truths: Sequence[Tensor]) -> float:
    """Mean PSNR in dB."""
    scores = [psnr(image, truth.clamp(0, 1)) for image, truth in zip(images, truths, strict=True)]
    return sum(scores) / len(scores)


def _plot(rows: list[dict[str, Any]]) -> Plot:
    series = []
    rows = [row for row in rows if row["psnr"] is not None]
    for name in dict.fromkeys(row["run"] for row in rows):
        part = [row for row in rows if row["run"] == name]
        x, y, low, high = ([row[column] for row in part] for column in ("median_ms", "psnr", "low_ms", "high_ms"))
        notes = [row["way"] for row in part]
        series.append(Series(name, x, y, x_low=low, x_high=high, notes=notes, style="points"))
    return Plot(
        name="frames", title="Quality against time of a frame", x_label="time per frame (ms)", y_label="PSNR (dB)",
        series=series, y_log=False, note="Up and left is better; bars are the quartiles of time.",
    )  # fmt: skip


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    """What every run's own settings take."""
    return [
        f"{row['run']}, {row['size']}: {row['median_ms']:.3g} ms [{row['low_ms']:.3g}, {row['high_ms']:.3g}]"
        + ("." if row["psnr"] is None else f", {row['psnr']:.2f} dB.")
        for row in rows
        if row["way"] == OWN
    ]
