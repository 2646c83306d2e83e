"""Whole training runs, each in a process of its own, with its scores and its peak memory."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dnerf.core.files import write_json
from dnerf.evaluation.provenance import commit

KEPT = "benchmark_run.json"
WEIGHTS = "model.safetensors"
QUIET = ("trainer.callbacks.progress_bar=null",)

# Linux counts a process's memory from before `exec`, when it was still a copy of its parent: started from here, a child
# would report at least as much as this process holds. So a small process starts it, and reads its peak.
LAUNCHER = """
import os, sys
pid = os.posix_spawn(sys.argv[2], sys.argv[2:], os.environ)
_, status, usage = os.wait4(pid, 0)
os.write(int(sys.argv[1]), str(usage.ru_maxrss).encode())
sys.exit(os.waitstatus_to_exitcode(status) & 255)
"""


@dataclass(frozen=True)
class Run:
    """What one training run came to.

    Args:
        psnr: mean over the scored frames, in dB.
        ssim: likewise.
        train_seconds: of training, loading and compiling left out.
        num_steps: optimiser steps.
        num_parameters: of the model.
        seconds_per_frame: to render one scored frame.
        model_mib: size of the weights file, in MiB.
        peak_mib: most memory that the process ever held (resident set size), in MiB.
    """

    psnr: float
    ssim: float
    train_seconds: float
    num_steps: int
    num_parameters: int
    seconds_per_frame: float
    model_mib: float
    peak_mib: float

    @property
    def step_ms(self) -> float:
        """Milliseconds per step."""
        return 1e3 * self.train_seconds / max(self.num_steps, 1)


def run_training(command: Sequence[str], overrides: Sequence[str], folder: Path) -> Run:
    """Train and score in a child process; a run made by the same clean commit is not repeated.

    Args:
        command: starts `scripts/train.py`; overrides and `out_dir` are appended.
        overrides: of its config.
        folder: of the run; what lies there from before is deleted.

    Raises:
        ValueError: if the child fails, with its last line.
    """
    folder = Path(folder)
    key = {"overrides": list(overrides), "commit": commit()}
    kept = _kept(folder, key)
    if kept is not None:
        return kept
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    words = [*command, *overrides, *QUIET, f"out_dir={folder.resolve()}"]
    log = folder.with_suffix(".log")
    code, peak = _watched(words, log)
    if code:
        lines = log.read_text(encoding="utf-8").split("\n")
        last = next((line for line in reversed(lines) if line.strip()), "no output")
        raise ValueError(f"training run failed with exit code {code}: {last} (log: {log})")
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    values = {name: metrics[name] for name in Run.__dataclass_fields__ if not name.endswith("_mib")}
    run = Run(**values, model_mib=model_mib(folder), peak_mib=peak / 2**20)
    write_json(folder / KEPT, {**key, "run": vars(run), "finished": time.time()})
    return run


def model_mib(folder: Path) -> float:
    """Size of a run's weights file, in MiB."""
    return (Path(folder) / WEIGHTS).stat().st_size / 2**20


def warm_up(command: Sequence[str], overrides: Sequence[str], folder: Path) -> None:
    """Train for a moment and forget it: the first process after a change of kernels compiles them, in time and memory.

    Args:
        command: as of `run_training`.
        overrides: likewise.
        folder: of the run, deleted afterwards. What fails here fails in the first run, with a message.
    """
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    few = ["trainer.num_steps=20", *QUIET, "evaluate_frames=1"]
    _watched([*command, *overrides, *few, f"out_dir={folder.resolve()}"], folder.with_suffix(".log"))
    shutil.rmtree(folder, ignore_errors=True)


def _watched(words: Sequence[str], log: Path) -> tuple[int, int]:
    """Run a command, output into a file; its exit code and the most bytes it held."""
    reader, writer = os.pipe()
    launcher = [sys.executable, "-I", "-S", "-c", LAUNCHER, str(writer), *words]
    with log.open("w", encoding="utf-8") as output, os.fdopen(reader) as pipe:
        try:
            child = subprocess.Popen(launcher, stdout=output, stderr=subprocess.STDOUT, pass_fds=(writer,))
        finally:
            os.close(writer)
        peak = pipe.read()
        code = child.wait()
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss is in bytes there, in KiB elsewhere
    return code, int(peak or 0) * unit


def _kept(folder: Path, key: dict[str, Any]) -> Run | None:
    try:
        saved = json.loads((folder / KEPT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    same = all(saved.get(name) == value for name, value in key.items())
    clean = key["commit"] != "unknown" and not key["commit"].endswith("-dirty")
    return Run(**saved["run"]) if same and clean and saved["run"].keys() == Run.__dataclass_fields__.keys() else None
