"""Logs of a training run: JSON lines, preview pictures, TensorBoard."""

import errno
import json
import math
import os
from pathlib import Path
from typing import Any

from torch import nn

from dnerf.data.frames import Frames
from dnerf.evaluation import evaluate
from dnerf.files import write_text
from dnerf.renderer import Renderer
from dnerf.training import TrainingRecord
from dnerf.video import contact_sheet, error_map, write_png

SHEET_COLUMNS = ("prediction", "truth", "error (yellow: 0.2 or more)")


class JsonLinesLog:
    """Appends every training record to a file, one JSON object a line, flushed at once.

    The first record of a continued run replaces those of the same step and later ones, which an earlier process
    wrote after its last checkpoint. No line is left half written.

    Args:
        path: the file; made if it is not there.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._is_trimmed = False

    def __call__(self, record: TrainingRecord, renderer: nn.Module) -> None:
        """Append a record."""
        if not self._is_trimmed:
            self._trim(record.step)
        values = {**vars(record), "losses": dict(record.losses)}
        line = (json.dumps(values) + "\n").encode()
        with self.path.open("ab", buffering=0) as file:
            size = file.seek(0, os.SEEK_END)
            try:
                if file.write(line) != len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
            except OSError:
                file.truncate(size)
                raise

    def _trim(self, step: int) -> None:
        if self.path.exists():
            lines = self.path.read_text(encoding="utf-8", errors="replace").splitlines()
            write_text(self.path, "".join(f"{line}\n" for line in lines if _step_of(line) < step))
        self._is_trimmed = True


def _step_of(line: str) -> float:
    """The step of a line; infinite if the line is broken."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return math.inf


class Previews:
    """Writes *prediction | truth | error* of one frame every so many steps.

    Args:
        folder: where PNG files go.
        frames: frames, of which the middle one is shown.
        every: steps between pictures.
        writer: a TensorBoard `SummaryWriter` that gets them too, or None.
    """

    def __init__(self, folder: Path, frames: Frames, every: int, writer: Any = None) -> None:
        self.folder = Path(folder)
        self.frames = frames
        self.every = every
        self.writer = writer
        # A continued run goes on after the pictures that are there.
        steps = [int(path.stem.partition("_")[2]) for path in self.folder.glob("step_*.png")]
        self._next = max(steps, default=0) + every

    def __call__(self, record: TrainingRecord, renderer: Renderer) -> None:
        """Render the preview if `every` steps have passed since the last."""
        if record.step < self._next:
            return
        self._next = record.step + self.every
        scores = []
        middle = self.frames.subset([len(self.frames) // 2])
        evaluate(renderer, middle, on_frame=lambda *score: scores.append(score))
        score, prediction, truth = scores[0]
        sheet = contact_sheet(
            [[prediction, truth, error_map(prediction, truth)]],
            columns=SHEET_COLUMNS,
            rows=[f"step {record.step}: {score.psnr:.2f} dB"],
        )
        write_png(sheet, self.folder / f"step_{record.step:07d}.png")
        if self.writer is not None:
            self.writer.add_image("preview", sheet, record.step, dataformats="HWC")


class TensorBoardLog:
    """Writes every training record's numbers as TensorBoard scalars.

    Args:
        writer: a `torch.utils.tensorboard.SummaryWriter`.
    """

    def __init__(self, writer: Any) -> None:
        self.writer = writer

    def __call__(self, record: TrainingRecord, renderer: nn.Module) -> None:
        """Write a record."""
        for name, value in record.losses.items():
            self.writer.add_scalar(f"loss/{name}", value, record.step)
        self.writer.add_scalar("psnr", record.psnr, record.step)
        self.writer.add_scalar("rays_per_step", record.num_rays, record.step)
        self.writer.add_scalar("samples_per_step", record.num_samples, record.step)


def tensorboard_writer(folder: Path) -> Any:
    """A TensorBoard writer.

    Raises:
        ValueError: if the extra is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ValueError("tensorboard=true needs the extra: pip install 'dnerf[tensorboard]'") from error
    return SummaryWriter(str(folder))
