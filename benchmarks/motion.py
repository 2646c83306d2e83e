"""How right recovered motion is: models trained on exact scenes, in which the way of every point is known."""

import math
from itertools import product
from statistics import fmean
from typing import Any

from benchmarks.endpoint_rows import endpoint_rows
from benchmarks.runs import run_training, warm_up
from benchmarks.scenes import scene_overrides
from benchmarks.suite import BarPlot, Row, Settings, SuiteResult, Table
from dnerf.motion import motion_model
from dnerf.scenes import make_scene

QUICK = {"experiments": ["flow"], "steps": {"walker": 40}, "seeds": [0], "resolution": 40}


def run(settings: Settings) -> SuiteResult:
    """Train every experiment on every scene with every seed; follow points of the true surfaces by its motion."""
    options = {**settings.options, **(QUICK if settings.quick else {})}
    scenes, experiments = list(options["steps"]), options["experiments"]
    warm_up(
        settings.train_command, _overrides(settings, options, scenes[0], experiments[0], 0),
        settings.work_dir / "warm_up",
    )  # fmt: skip
    rows = [
        _measured(settings, options, scene, experiment, seed)
        for scene, experiment, seed in product(scenes, experiments, options["seeds"])
    ]
    return SuiteResult(
        title="Recovered motion: 3-D end-point error on exact scenes",
        summary=(
            f"Models are trained for a number of steps on exact scenes of {options['resolution']} x "
            f"{options['resolution']} pixels (`{' '.join(options['overrides'])}`). Points near the surface of exactly "
            "one body are then carried from time 0 to 0.1, 0.25, 0.5, 0.75 and 1 by the recovered motion, and compared "
            "with where the scene carries them; all in world units."
        ),
        tables=[
            Table(
                "End-point errors",
                rows,
                "Means over the five times. moved: how far points go, the error of a model in which nothing moves. "
                "residual: by how much the model's own inverse misses; psnr of held-out frames.",
            )
        ],
        plots=[_plot(rows, scenes, experiments)],
        findings=[_finding(rows, experiment) for experiment in experiments],
    )


def _overrides(settings: Settings, options: dict[str, Any], scene: str, experiment: str, seed: int) -> list[str]:
    return [
        f"experiment={experiment}", *scene_overrides(scene, options["resolution"], None, settings.quick),
        f"trainer.num_steps={options['steps'][scene]}", "trainer.max_seconds=null", "evaluate_split=val",
        "evaluate_frames=10", f"seed={seed}", f"device={settings.device}", *options["overrides"],
    ]  # fmt: skip


def _measured(settings: Settings, options: dict[str, Any], scene: str, experiment: str, seed: int) -> Row:
    folder = settings.work_dir / f"{scene}-{experiment}-seed{seed}"
    trained = run_training(settings.train_command, _overrides(settings, options, scene, experiment, seed), folder)
    finished = settings.finished(str(folder))
    if (model := motion_model(finished["renderer"])) is None:
        raise ValueError(f"motion.experiments: the motion of {experiment} is not known, it has no deformation")
    ends = endpoint_rows(model.cpu(), make_scene(scene), similarity=finished["data"].world().similarity)
    means = {name: fmean(row[name] for row in ends) for name in ("moved", "mean_error", "median_error", "residual")}
    return {
        "scene": scene, "experiment": experiment, "seed": seed, "steps": trained.num_steps, **means,
        "psnr": trained.psnr, "model_MiB": trained.model_mib,
    }  # fmt: skip


def _mean(rows: list[Row], scene: str, experiment: str) -> float:
    return fmean(r["mean_error"] for r in rows if (r["scene"], r["experiment"]) == (scene, experiment))


def _plot(rows: list[Row], scenes: list[str], experiments: list[str]) -> BarPlot:
    still = [fmean(row["moved"] for row in rows if row["scene"] == scene) for scene in scenes]
    values = {name: [_mean(rows, scene, name) for scene in scenes] for name in experiments}
    return BarPlot(
        "motion", "End-point error of recovered motion", "mean end-point error (world units)", scenes,
        {**values, "nothing moves": still}, "Means over seeds; shorter is better.", log=True,
    )  # fmt: skip


def _finding(rows: list[Row], experiment: str) -> str:
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    errors = [_mean(rows, scene, experiment) for scene in scenes]
    mean = math.exp(fmean(math.log(max(error, 1e-12)) for error in errors))
    listed = ", ".join(f"{scene} {error:.4f}" for scene, error in zip(scenes, errors))
    return f"{experiment}: geometric mean of the end-point errors {mean:.4f} world units ({listed})."
