"""Quality against seconds of training: named experiments on named scenes, several seeds, memory too."""

from itertools import product
from statistics import fmean
from typing import Any

from benchmarks.runs import Run, run_training, warm_up
from benchmarks.scenes import scene_overrides
from benchmarks.suite import Plot, Series, Settings, SuiteResult, Table

QUICK = {"scenes": ["walker"], "seconds": [1, 3], "seeds": [0], "resolution": 40, "experiments": ["fast"]}
STYLES = ("line", "dashed", "points")
VARIED = ("scenes", "experiments", "seconds", "seeds")


def run(settings: Settings) -> SuiteResult:
    """Train every experiment on every scene for every budget and seed, one process after another."""
    options = {**settings.options, **(QUICK if settings.quick else {})}
    runs: dict[tuple[str, str, float], list[Run]] = {}
    scene, experiment, seconds, seed = (options[name][0] for name in VARIED)
    first = _overrides(settings, options, scene, experiment, seconds, seed)
    warm_up(settings.train_command, first, settings.work_dir / "warm_up")
    rows = []
    for scene, experiment, seconds, seed in product(*(options[name] for name in VARIED)):
        done = _train(settings, options, scene, experiment, seconds, seed)
        runs.setdefault((scene, experiment, seconds), []).append(done)
        rows.append({"scene": scene, "experiment": experiment, "budget_s": seconds, "seed": seed, **vars(done)})
    means = [_mean_row(*key, group, options) for key, group in runs.items()]
    return SuiteResult(
        title="PSNR against seconds of training",
        summary=(
            "Every run is a process of its own that trains for the given seconds (wall clock; loading data and "
            "compiling kernels left out, as the trainer counts), with learning rates that end with the budget, and is "
            f"then scored on held-out frames, {options['resolution']} pixels wide. "
            "Memory is the most the process ever held, data, training and scoring together; `model_MiB` is the size of "
            "the weights file."
            + "".join(
                f" `{name}` runs with `{' '.join(words)}`."
                for name, words in options["overrides"].items()
                if name in options["experiments"]
            )
        ),
        tables=[
            Table("Means over seeds", means, "psnr_low, psnr_high: worst and best seed. frames: how many were scored."),
            Table("Runs", rows),
        ],
        plots=[quality_plot(means)] if len(options["seconds"]) > 1 else [],
        findings=_findings(means),
    )


def _train(settings: Settings, options: dict[str, Any], scene: str, experiment: str, seconds: float, seed: int) -> Run:
    folder = settings.work_dir / f"{scene}-{experiment}-{seconds:g}s-seed{seed}"
    return run_training(settings.train_command, _overrides(settings, options, scene, experiment, seconds, seed), folder)


def _overrides(
    settings: Settings, options: dict[str, Any], scene: str, experiment: str, seconds: float, seed: int
) -> list[str]:
    split = options["splits"].get(scene, "test")
    # The scene comes after the experiment, which may name one of its own.
    return [
        f"experiment={experiment}",
        *scene_overrides(scene, options["resolution"], options["data_root"], settings.quick),
        f"trainer.max_seconds={seconds}", "trainer.num_steps=1000000000", f"seed={seed}", f"device={settings.device}",
        f"evaluate_split={split}", f"evaluate_frames={options['frames'].get(experiment, 'null')}",
        *options["overrides"].get(experiment, []),
    ]  # fmt: skip


def _mean_row(scene: str, experiment: str, seconds: float, runs: list[Run], options: dict[str, Any]) -> dict[str, Any]:
    scores = [run.psnr for run in runs]
    return {
        "scene": scene, "split": options["splits"].get(scene, "test"), "resolution": options["resolution"],
        "experiment": experiment, "budget_s": seconds, "seeds": len(runs), "psnr": fmean(scores),
        "psnr_low": min(scores), "psnr_high": max(scores), "ssim": fmean(run.ssim for run in runs),
        "frames": options["frames"].get(experiment, "all"), "steps": round(fmean(run.num_steps for run in runs)),
        "step_ms": fmean(run.step_ms for run in runs), "frame_s": fmean(run.seconds_per_frame for run in runs),
        "model_MiB": max(run.model_mib for run in runs), "peak_MiB": max(run.peak_mib for run in runs),
        "parameters": runs[0].num_parameters,
    }  # fmt: skip


def quality_plot(rows: list[dict[str, Any]]) -> Plot:
    """PSNR against seconds of training, a line for each scene and experiment."""
    series, scenes = [], list(dict.fromkeys(row["scene"] for row in rows))
    for number, experiment in enumerate(dict.fromkeys(row["experiment"] for row in rows)):
        for color, scene in enumerate(scenes):
            part = [row for row in rows if row["scene"] == scene and row["experiment"] == experiment]
            x, y, low, high = ([row[name] for row in part] for name in ("budget_s", "psnr", "psnr_low", "psnr_high"))
            style = STYLES[number % len(STYLES)]
            series.append(Series(f"{scene}, {experiment}", x, y, low, high, style=style, color=color))
    return Plot(
        name="training", title="Quality against training time", x_label="seconds of training",
        y_label="PSNR of held-out frames (dB)", series=series, y_log=False,
        note="A colour for each scene, a style for each experiment. Band: worst to best seed. Up and left is better.",
    )  # fmt: skip


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    return [
        f"{row['scene']} ({row['split']}), {row['experiment']}, {row['budget_s']:g} s: {row['psnr']:.2f} dB "
        f"[{row['psnr_low']:.2f}, {row['psnr_high']:.2f}], {row['frame_s']:.2g} s a frame, weights of "
        f"{row['model_MiB']:.1f} MiB, {row['peak_MiB']:.0f} MiB of memory at most."
        for row in rows
    ]
