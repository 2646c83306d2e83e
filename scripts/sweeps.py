"""Sweeps: many runs of one command (`--multirun`). A job that fails is recorded, and one table sums the sweep up.

python scripts/sweeps.py FOLDER prints a sweep's table anew, after some of its runs were run again.
"""

import csv
import hashlib
import io
import json
import re
import shutil
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict

from dnerf.core.files import write_text

ERRORS = "errors"
NAME_LENGTH = 120
NOT_NAMED = {"out_dir", "resume"}
COLUMNS = ("status", "num_steps", "train_seconds", "psnr", "ssim")


class SweepWatch(Callback):
    """Prepares a sweep's folder, and remembers it for `finish`; Hydra calls it in the process that starts the jobs."""

    folder: Path | None = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Forget former failures, and have jobs named by what the sweep varies alone."""
        SweepWatch.folder = Path(config.hydra.sweep.dir)
        shutil.rmtree(SweepWatch.folder / ERRORS, ignore_errors=True)
        overrides = OverridesParser.create().parse_overrides(list(config.hydra.overrides.task))
        fixed = sorted({o.key_or_group for o in overrides if not o.is_sweep_override()} | NOT_NAMED)
        with open_dict(config):
            config.hydra.overrides.hydra.append(
                f"hydra.job.config.override_dirname.exclude_keys=[{','.join(map(_quoted, fixed))}]"
            )


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "\\'") + "'"


def sweep_folder() -> Path:
    """The folder that the sweep of this job has for all its runs."""
    return Path(HydraConfig.get().sweep.dir)


def job_name() -> str:
    """This job's name: what it varies, fit for a file name."""
    job = HydraConfig.get().job
    # Only characters that Hydra's command line takes without quotes, so that a run's folder can be named there.
    name = re.sub(r"[^\w.+-]", "_", str(job.override_dirname or job.num))
    if len(name) <= NAME_LENGTH:
        return name
    return f"{name[: NAME_LENGTH - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def begin_job() -> None:
    """Forget this job's last failure."""
    _error_path().unlink(missing_ok=True)


def record_failure(error: BaseException) -> None:
    """Keep a failed job's traceback in the sweep's folder."""
    SweepWatch.folder = SweepWatch.folder or sweep_folder()
    write_text(_error_path(), "".join(traceback.format_exception(error)))


def _error_path() -> Path:
    return sweep_folder() / ERRORS / f"{job_name()}.txt"


def finish() -> None:
    """At the end of a sweep, print and save its table; leave with exit code 2 if a job has failed.

    Raises:
        ValueError: naming the failed jobs.
    """
    folder = SweepWatch.folder
    if folder is None:
        return
    rows = collect(folder)
    if any(row["overrides"] for row in rows):
        text = table(rows)
        print(text)
        write_text(folder / "table.txt", text + "\n")
        write_text(folder / "table.csv", as_csv(rows))
        print(f"table: {folder / 'table.csv'}")
    failed = sorted(path.stem for path in (folder / ERRORS).glob("*.txt"))
    if failed:
        raise ValueError(
            f"{len(failed)} of the sweep's jobs failed: {'; '.join(failed[:5])}{' ...' if len(failed) > 5 else ''}. "
            f"Why stands in {folder / ERRORS}; the same command with resume=true runs only what is missing"
        )


def collect(folder: Path) -> list[dict[str, Any]]:
    """What is known of each run below a folder: name, overrides, status, and the results that it has."""
    errors = {path.stem for path in (folder / ERRORS).glob("*.txt")}
    runs = {path.parent.name for path in folder.glob("*/overrides.json")}
    rows = []
    for name in sorted(errors | runs):
        training, metrics = (_read(folder / name / f"{kind}.json", {}) for kind in ("training", "metrics"))
        status = "failed" if name in errors else "done" if training else "unfinished"
        overrides = [str(override) for override in _read(folder / name / "overrides.json", [])]
        rows.append({
            "run": name, "overrides": dict(override.split("=", 1) for override in overrides if "=" in override),
            "status": status, **{key: metrics.get(key, training.get(key)) for key in COLUMNS[1:]},
        })  # fmt: skip
    return rows


def _read(path: Path, default: Any) -> Any:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return default
    return value if isinstance(value, type(default)) else default


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The runs as lines of text, one column per setting that varies; below, means over seeds if seeds vary."""
    keys = varied(rows)
    lines = [[*keys, *COLUMNS]]
    lines += [[*(row["overrides"].get(key, "") for key in keys), *(_cell(row[c]) for c in COLUMNS)] for row in rows]
    text = _aligned(lines)
    others = [key for key in keys if key != "seed"]
    if "seed" not in keys or not any(row["psnr"] is not None for row in rows):
        return text
    groups: dict[tuple[str, ...], list[float]] = {}
    for row in rows:
        if row["psnr"] is not None:
            groups.setdefault(tuple(row["overrides"].get(key, "") for key in others), []).append(row["psnr"])
    lines = [[*others, "runs", "psnr", "sd"]]
    for group, values in groups.items():
        spread = _cell(stdev(values)) if len(values) > 1 else ""
        lines.append([*group, str(len(values)), _cell(fmean(values)), spread])
    return f"{text}\n\n{_aligned(lines)}"


def varied(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The settings whose values differ between runs, in the order of the command; the run's name if none does."""
    known = [row["overrides"] for row in rows if row["overrides"]]
    keys = dict.fromkeys(key for overrides in known for key in overrides)
    return [key for key in keys if key not in NOT_NAMED and len({o.get(key) for o in known}) > 1]


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """The runs as comma-separated values, all settings included."""
    keys = list(dict.fromkeys(key for row in rows for key in row["overrides"] if key not in NOT_NAMED))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", *keys, *COLUMNS])
    for row in rows:
        writer.writerow([row["run"], *(row["overrides"].get(key) for key in keys), *(row[c] for c in COLUMNS)])
    return text.getvalue()


def _cell(value: object) -> str:
    return "" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


def _aligned(lines: Sequence[Sequence[str]]) -> str:
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths)).rstrip() for line in lines)


def _sweep_dir(out_dir: str | None, stamp: str) -> str:
    return out_dir or f"multirun/{stamp}"


OmegaConf.register_new_resolver("sweep_dir", _sweep_dir, replace=True)


if __name__ == "__main__":
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        print("error: expected one argument, the folder of a sweep", file=sys.stderr)
        sys.exit(2)
    print(table(collect(Path(sys.argv[1]))))
