"""What scenes need: the plan's decisions, and what each is worth against its other candidates, trained to the end."""

from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import fmean, stdev
from typing import Any, NamedTuple

from benchmarks.runs import Run, run_training, warm_up
from benchmarks.scenes import scene_overrides
from benchmarks.suite import Settings, SuiteResult, Table
from dnerf.planning.plan import FILE, Plan, load_plan

QUICK = {"scenes": ["static"], "seconds": 2, "seeds": [0], "resolution": 32, "frames": 2}
CLEAR = 2.0  # standard errors over seeds from which a candidate counts as better than another


class Trained(NamedTuple):
    """One run of `experiment=auto`, and what it decided."""

    run: Run
    plan: Plan


def run(settings: Settings) -> SuiteResult:
    """Train each scene as it plans itself, then once more for every other candidate of every part."""
    options = {**settings.options, **(QUICK if settings.quick else {})}
    candidates = {str(name): list(part["candidates"]) for name, part in options["parts"].items()}
    rows: list[dict[str, Any]] = []
    for number, scene in enumerate(options["scenes"]):
        if not number:
            warm_up(settings.train_command, _overrides(settings, options, scene, 0), settings.work_dir / "warm_up")
        planned = [_train(settings, options, scene, seed, {}) for seed in options["seeds"]]
        for part in candidates:
            rows += _rows(settings, options, scene, part, candidates[part], planned)
    counts = Counter(row["verdict"] for row in rows)
    return SuiteResult(
        title="What scenes need",
        summary=(
            f"`experiment=auto` with a budget of {options['seconds']:g} s for each seed, scored on held-out frames at "
            f"{options['resolution']} x {options['resolution']} pixels; then the same with one decision replaced by "
            "another candidate and all others given. All get the same time, so a part must earn what it costs."
        ),
        tables=[
            Table(
                "Decisions",
                rows,
                "worth_dB: mean over seeds of what the choice scores above the other candidate; error_dB: its standard "
                f"error. A decision is wrong if the other candidate is better by {CLEAR:g} standard errors, right if "
                "the choice is, and open in between. seconds: what the decision took.",
            )
        ],
        findings=[
            f"{len(rows)} decisions: {counts['right']} right, {counts['wrong']} wrong, {counts['open']} within noise.",
            *(
                f"Wrong: {row['scene']}, {row['part']}: {row['choice']}, though {row['other']} scores "
                f"{-row['worth_dB']:.2f} dB more."
                for row in rows
                if row["verdict"] == "wrong"
            ),
        ],
    )


def _rows(
    settings: Settings, options: Mapping[str, Any], scene: str, part: str, names: Sequence[str], planned: list[Trained]
) -> list[dict[str, Any]]:
    """One row for each candidate that was chosen and each that was not."""
    rows = []
    for choice in dict.fromkeys(trained.plan.choices[part] for trained in planned):
        chosen = [(s, t) for s, t in zip(options["seeds"], planned, strict=True) if t.plan.choices[part] == choice]
        decisions = [trained.plan.decisions[part] for _, trained in chosen]
        for other in names:
            if other == choice:
                continue
            differences = []
            for seed, trained in chosen:
                replaced = _train(settings, options, scene, seed, {**trained.plan.choices, part: other})
                differences.append(trained.run.psnr - replaced.run.psnr)
            worth = fmean(differences)
            error = stdev(differences) / len(differences) ** 0.5 if len(differences) > 1 else None
            rows.append(
                {
                    "scene": scene, "part": part, "choice": choice, "seeds": len(chosen), "other": other,
                    "by": ", ".join(dict.fromkeys(decision.by for decision in decisions)), "worth_dB": worth,
                    "error_dB": error, "seconds": fmean(decision.seconds for decision in decisions),
                    "verdict": _verdict(worth, error),
                }
            )  # fmt: skip
    return rows


def _verdict(worth: float, error: float | None) -> str:
    if error is None or abs(worth) <= CLEAR * error:
        return "open"
    return "right" if worth > 0 else "wrong"


def _train(
    settings: Settings, options: Mapping[str, Any], scene: str, seed: int, choices: Mapping[str, str]
) -> Trained:
    folder = settings.work_dir / f"{scene}-{'-'.join(choices.values()) or 'planned'}-seed{seed}"
    given = [f"plan.{part}={choice}" for part, choice in choices.items()]
    done = run_training(settings.train_command, [*_overrides(settings, options, scene, seed), *given], folder)
    return Trained(done, load_plan(folder / FILE))


def _overrides(settings: Settings, options: Mapping[str, Any], scene: str, seed: int) -> list[str]:
    split = options["splits"].get(scene, "test")
    return [
        "experiment=auto",
        *scene_overrides(scene, options["resolution"], options["data_root"], settings.quick),
        f"trainer.max_seconds={options['seconds']}", "trainer.num_steps=1000000000", f"seed={seed}",
        f"device={settings.device}", f"evaluate_split={split}", f"evaluate_frames={options['frames']}",
        *options["overrides"],
    ]  # fmt: skip
