"""Every representation of the canonical scene, trained alike: what it costs, what it scores, and how it looks."""

from dataclasses import replace
from statistics import fmean
from typing import Any

import torch

from benchmarks import profile
from benchmarks.runs import Run, run_training
from benchmarks.scenes import scene_overrides
from benchmarks.suite import Settings, SuiteResult, Table
from dnerf.visualization import View, render_layers
from dnerf.visualization.video import contact_sheet, write_png

QUICK = {"scene": "static", "seconds": 2, "seeds": [0], "resolution": 32, "frames": 2, "rows": ["grid"]}
SHEET = "representations.png"
LAYERS = ("rgb", "normals")
NUM_PARTS = 4  # of a step, that are named


def run(settings: Settings) -> SuiteResult:
    """Train each representation for each seed; the first seed's models show one held-out frame and its normals."""
    options = {**settings.options, **(QUICK if settings.quick else {})}
    kinds = {name: kind for name, kind in settings.options["kinds"].items() if name in options["rows"]}
    rows, parts, images = [], [], []
    for name, kind in kinds.items():
        folders = [settings.work_dir / f"{name}-seed{seed}" for seed in options["seeds"]]
        runs = [
            run_training(settings.train_command, _overrides(settings, options, kind["overrides"], seed), folder)
            for seed, folder in zip(options["seeds"], folders, strict=True)
        ]
        rows.append(_row(name, kind, runs))
        if name in options["profiled"]:
            parts.append({"representation": name, **_parts_of_a_step(settings, options, kind["overrides"])})
        images.append(_shown(settings, options, str(folders[0])))
    write_png(contact_sheet(list(zip(*images, strict=True)), list(kinds), LAYERS), settings.work_dir / SHEET)
    return SuiteResult(
        title="Representations",
        summary=(
            f"Each representation is trained for {options['seconds']:g} s on {options['scene']}, "
            f"{options['resolution']} x {options['resolution']} pixels, {len(options['seeds'])} seed(s), and scored on "
            f"held-out frames. {SHEET}, among the runs, shows one of these frames from each, and its normals."
        ),
        tables=[
            Table(
                "Representations",
                rows,
                "overrides: of scripts/train.py. psnr: mean over seeds, low and high the worst and best of them. "
                "MiB: of the weights file. frame_s: one held-out frame.",
            ),
            Table("Where a step goes", parts, "Early steps, at 100 x 100 pixels; suite=profile says more of each."),
        ],
    )


def _row(name: str, kind: dict[str, Any], runs: list[Run]) -> dict[str, Any]:
    return {
        "representation": name, "stores": kind["stores"], "overrides": " ".join(kind["overrides"]),
        "parameters": runs[0].num_parameters, "MiB": fmean(run.model_mib for run in runs),
        "steps": round(fmean(run.num_steps for run in runs)), "step_ms": fmean(run.step_ms for run in runs),
        "frame_s": fmean(run.seconds_per_frame for run in runs), "peak_MiB": max(run.peak_mib for run in runs),
        "seeds": len(runs), "psnr": fmean(run.psnr for run in runs), "psnr_low": min(run.psnr for run in runs),
        "psnr_high": max(run.psnr for run in runs),
    }  # fmt: skip


def _parts_of_a_step(settings: Settings, options: dict[str, Any], words: list[str]) -> dict[str, Any]:
    """A step's time, and the largest parts of it, see `benchmarks.profile`."""
    scene = {name: options[name] for name in ("scene", "data_root")}
    steps, parts, _ = profile.run(
        replace(settings, options={**scene, "overrides": words, "warm_steps": options["profiled_after"]})
    ).tables
    named = {f"part {i}": f"{row['part']} {row['share']:.0%}" for i, row in enumerate(parts.rows[:NUM_PARTS], start=1)}
    return {"step_ms": steps.rows[-1]["median_ms"], **named}


def _shown(settings: Settings, options: dict[str, Any], folder: str) -> list[Any]:
    """The layers of one held-out frame, at half its size."""
    model = settings.finished(folder)
    frames = model["data"].frames("test")
    number = min(options["frame"], len(frames) - 1)
    view = View(frames.camera(number), float(frames.times[number]))
    layers = render_layers(model["renderer"], view, None, LAYERS, chunk=model["chunk"])
    share = layers["opacity"][..., None].clip(0, 1)
    shown = (layers["rgb"] / 255, share * 0.5 * (layers["normals"] + 1) + 1 - share)
    halved = (torch.nn.functional.avg_pool2d(torch.from_numpy(x).movedim(2, 0).float(), 2) for x in shown)
    return [x.movedim(0, 2) for x in halved]


def _overrides(settings: Settings, options: dict[str, Any], words: list[str], seed: int) -> list[str]:
    return [
        *words,
        *scene_overrides(options["scene"], options["resolution"], options["data_root"], settings.quick),
        f"trainer.max_seconds={options['seconds']}", "trainer.num_steps=1000000000", f"seed={seed}",
        f"device={settings.device}", f"evaluate_frames={options['frames']}",
    ]  # fmt: skip
