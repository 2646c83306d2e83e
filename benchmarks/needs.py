"""What a scene needs: short trainings with one part removed at a time, and the smallest model that is enough."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from benchmarks.runs import Run, run_training, warm_up
from benchmarks.scenes import scene_overrides
from benchmarks.suite import Plot, Series, Settings, SuiteResult, Table

TOLERANCE = 0.1  # dB below the best that still counts as good enough
QUICK = {"seconds": 1, "seeds": [0], "resolution": 40, "frames": 2}
FULL = "everything"
SMALLEST = "smallest"


@dataclass(frozen=True)
class Trial:
    """Mean scores of one configuration over the seeds; with one seed, no spread."""

    psnr: float
    spread: float | None
    step_ms: float
    frame_s: float
    model_mib: float
    peak_mib: float


def run(settings: Settings) -> SuiteResult:
    """Train with everything, without each part, and without all parts that were not missed."""
    options = {**settings.options, **(QUICK if settings.quick else {})}
    parts = dict(list(options["parts"].items())[:2] if settings.quick else options["parts"])
    train = _trainer(settings, options)

    def trial(names: Sequence[str]) -> Trial:
        return train(f"without {', '.join(names)}", removing(names, parts, options["includes"]))

    full = train(FULL, [])
    without = {name: trial([name]) for name in parts}
    removed, smallest = smallest_enough(full, without, trial)
    best = max([full, smallest, *without.values()], key=lambda t: t.psnr)
    rows = [_row(FULL, full, full), *(_row(f"without {name}", t, full) for name, t in without.items())]
    if len(removed) > 1:
        rows.append(_row(f"{SMALLEST}: without {', '.join(removed)}", smallest, full))
    kept = last_of_each([*_base(options), *removing(removed, parts, options["includes"])])
    scene = scene_overrides(options["scene"], options["resolution"], options["data_root"])
    line = shlex.join(kept)
    missed = ", ".join(name for name in parts if name not in removed) or "none"
    return SuiteResult(
        title=f"What {options['scene']} needs",
        summary=(
            f"`experiment={options['experiment']}` on `{options['scene']}` with every part in place "
            f"(`{' '.join(options['full'])}`), then with one part removed at a time, each trained for "
            f"{options['seconds']:g} s and scored on {options['frames']} held-out frames of {options['resolution']} x "
            f"{options['resolution']} pixels. All get the same time, so a part must earn what it costs. Parts whose "
            f"removal loses at most {TOLERANCE} dB are then removed together; if that ends more than {TOLERANCE} dB "
            "below the best so far, the most valuable ones are put back, as few as a search by halves finds to do."
        ),
        tables=[
            Table(
                "Parts",
                rows,
                "buys_dB: what the removed part is worth; costs_ms and costs_MiB: what it takes per step and in peak "
                "memory. spread_dB: best less worst seed (none with one seed); smaller differences mean nothing. "
                "model_MiB: size of the weights file.",
            )
        ],
        plots=[_plot(rows, str(options["scene"]))],
        findings=[
            f"The smallest configuration within {TOLERANCE} dB of the best ({best.psnr:.2f} dB) reaches "
            f"{smallest.psnr:.2f} dB with weights of {smallest.model_mib:.1f} MiB, {smallest.step_ms:.3g} ms a step, "
            f"{smallest.peak_mib:.0f} MiB of memory: `{line}`",
            f"To train it: `python scripts/train.py {shlex.join([*kept, *scene])}`",
            f"{options['scene']} does not miss: {', '.join(removed) or 'nothing'}. Kept: {missed}.",
        ],
    )


def last_of_each(overrides: Sequence[str]) -> list[str]:
    """Overrides without those whose key comes again later, which would be replaced anyhow."""
    last = {override.partition("=")[0]: override for override in overrides}
    return [override for override in overrides if last[override.partition("=")[0]] == override]


def removing(
    names: Sequence[str], parts: Mapping[str, Sequence[str]], includes: Mapping[str, Sequence[str]]
) -> list[str]:
    """Overrides that remove some parts together.

    Args:
        names: of the parts.
        parts: overrides that remove each alone.
        includes: parts that are gone with another, whose own overrides would not fit any more.
    """
    gone = {part for name in names for part in includes.get(name, ())}
    return [override for name in names if name not in gone for override in parts[name]]


def smallest_enough(
    full: Trial, without: Mapping[str, Trial], trial: Callable[[Sequence[str]], Trial]
) -> tuple[list[str], Trial]:
    """Names of the parts that can go together, and what is left then: within `TOLERANCE` of the best seen before.

    Only parts that are not missed alone can go. They are put back in the order of what they are worth; how many must be
    is found by bisection, which takes for granted that more parts are not worse.

    Args:
        full: scores with all parts.
        without: scores with one part removed.
        trial: trains and scores without some parts.
    """
    enough = max(t.psnr for t in [full, *without.values()]) - TOLERANCE
    harmless = [name for name, t in without.items() if t.psnr >= full.psnr - TOLERANCE]
    removed = sorted(harmless, key=lambda name: without[name].psnr)
    if not removed:
        return [], full
    fewest, most, found = 0, len(removed) - 1, without[removed[-1]]
    while fewest < most:
        put_back = (fewest + most) // 2
        together = trial(removed[put_back:])
        if together.psnr >= enough:
            most, found = put_back, together
        else:
            fewest = put_back + 1
    return removed[most:], found


def _base(options: Mapping[str, Any]) -> list[str]:
    return [f"experiment={options['experiment']}", *options["full"]]


def _trainer(settings: Settings, options: Mapping[str, Any]) -> Callable[[str, Sequence[str]], Trial]:
    scene = scene_overrides(options["scene"], options["resolution"], options["data_root"], settings.quick)
    common = [
        *_base(options), *scene, f"trainer.max_seconds={options['seconds']}", "trainer.num_steps=1000000000",
        f"evaluate_frames={options['frames']}", f"evaluate_split={options['split']}", f"device={settings.device}",
    ]  # fmt: skip
    warm_up(settings.train_command, common, settings.work_dir / "warm_up")

    def train(name: str, overrides: Sequence[str]) -> Trial:
        runs: list[Run] = []
        for seed in options["seeds"]:
            folder = settings.work_dir / f"{name.replace(' ', '_').replace(',', '')}-seed{seed}"
            runs.append(run_training(settings.train_command, [*common, *overrides, f"seed={seed}"], folder))
        return Trial(
            psnr=fmean(r.psnr for r in runs),
            spread=max(r.psnr for r in runs) - min(r.psnr for r in runs) if len(runs) > 1 else None,
            step_ms=fmean(r.step_ms for r in runs),
            frame_s=fmean(r.seconds_per_frame for r in runs),
            model_mib=max(r.model_mib for r in runs),
            peak_mib=max(r.peak_mib for r in runs),
        )

    return train


def _row(name: str, trial: Trial, full: Trial) -> dict[str, Any]:
    is_full = trial is full
    return {
        "configuration": name,
        "psnr": trial.psnr,
        "spread_dB": trial.spread,
        "buys_dB": None if is_full else full.psnr - trial.psnr,
        "step_ms": trial.step_ms,
        "costs_ms": None if is_full else full.step_ms - trial.step_ms,
        "frame_s": trial.frame_s,
        "peak_MiB": trial.peak_mib,
        "costs_MiB": None if is_full else full.peak_mib - trial.peak_mib,
        "model_MiB": trial.model_mib,
    }


def _plot(rows: Sequence[Mapping[str, Any]], scene: str) -> Plot:
    series = []
    for row in rows:
        half = 0.5 * (row["spread_dB"] or 0.0)
        ends = [row["psnr"] - half], [row["psnr"] + half]
        name = row["configuration"].partition(":")[0]
        series.append(Series(name, [row["step_ms"]], [row["psnr"]], *ends, style="points"))
    return Plot(
        name="needs",
        title=f"What each part is worth on {scene}",
        x_label="time per training step (ms)",
        y_label="PSNR of held-out frames after equal time (dB)",
        series=series,
        y_log=False,
        note="Up and to the left is better; a point as high as `everything` is a part that this scene does not need.",
    )
