"""Logs of a training run: JSON lines and preview images."""

import errno
import json
import math
import os
from typing import Any

from dnerf.core.checks import check_whole
from dnerf.core.files import write_text
from dnerf.data.scene_record import SCENE, SceneRecord
from dnerf.data.source import DataSource
from dnerf.evaluation.scores import evaluate
from dnerf.training.run import Callback, Run
from dnerf.visualization.video import comparison_sheet, write_png


class JsonLinesLog(Callback):
    """Appends every training record to a file in the run's folder, one JSON object a line, flushed at once.

    The first record of a continued run replaces those of the same step and later ones, which an earlier process
    wrote after its last checkpoint. No line is left half written.
    """

    def __init__(self, name: str = "log.jsonl") -> None:
        self.name = name

    def on_train_begin(self, run: Run) -> None:
        """Make the folder; the file is trimmed before the first record."""
        run.folder_for(self).mkdir(parents=True, exist_ok=True)
        self._is_trimmed = False

    def on_step_end(self, run: Run) -> None:
        """Append a record."""
        if run.record is None:
            return
        path = run.folder_for(self) / self.name
        if not self._is_trimmed and path.exists():
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
            write_text(path, "".join(f"{line}\n" for line in lines if _step_of(line) < run.record.step))
        self._is_trimmed = True
        line = (json.dumps({**vars(run.record), "losses": dict(run.record.losses)}) + "\n").encode()
        with path.open("ab", buffering=0) as file:
            size = file.seek(0, os.SEEK_END)
            try:
                if file.write(line) != len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
            except OSError:
                file.truncate(size)
                raise


def _step_of(line: str) -> float:
    """The step of a line; infinite if the line is broken."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return math.inf


class Previews(Callback):
    """Writes *prediction | truth | error* of the middle frame of a split every so many steps.

    Raises:
        ValueError: if `every` is not positive, or the data have no such split.
    """

    def __init__(self, data: DataSource, every: int = 500, split: str = "val") -> None:
        check_whole("every", every)
        data.check(split)
        self.data, self.every, self.split = data, every, split

    def on_train_begin(self, run: Run) -> None:
        """Read the frame; a continued run goes on after the images that are there."""
        self._folder = run.folder_for(self) / "previews"
        if (run.folder_for(self) / SCENE).exists():
            self.data.settle(SceneRecord.read(run.folder_for(self)).world)
        frames = self.data.frames(self.split)
        self._frame = frames.subset([len(frames) // 2])
        steps = [int(path.stem.partition("_")[2]) for path in self._folder.glob("step_*.png")]
        self._next = max(steps, default=0) + self.every

    def on_step_end(self, run: Run) -> None:
        """Render the preview at the first record after `every` steps."""
        if run.record is None or run.step < self._next:
            return
        self._next = run.step + self.every
        scores: list[Any] = []
        evaluate(run.renderer, self._frame, on_frame=lambda *score: scores.append(score))
        score, prediction, truth = scores[0]
        sheet = comparison_sheet([(prediction, truth)], [f"step {run.step}: {score.psnr:.2f} dB"])
        write_png(sheet, self._folder / f"step_{run.step:07d}.png")
