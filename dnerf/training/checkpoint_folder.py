"""Checkpoints of a run: a folder of them, and the callback that writes and reads them."""

import hashlib
import logging
import re
from pathlib import Path

from dnerf.core.checks import check_whole
from dnerf.core.files import write_bytes
from dnerf.data.frames import Frames
from dnerf.training.checkpoint import encode_run, max_bytes, restore_run
from dnerf.training.records import not_finite
from dnerf.training.run import Callback, Run
from dnerf.training.tensor_files import decode, read_limited

CHECKPOINTS = "checkpoints"  # the folder's name in that of a run
NAME = re.compile(r"step_(\d{8,})\.safetensors")

logger = logging.getLogger(__name__)


class CheckpointFolder:
    """Checkpoints of one run, `step_<number>.safetensors`; the newest and the good one before it are kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self._good: Path | None = None

    def save(self, step: int, content: bytes) -> None:
        """Write a checkpoint, then remove all but it and the last one that was written or read well.

        Raises:
            OSError: if it cannot be written; those that were there stay.
        """
        path = self.folder / f"step_{step:08d}.safetensors"
        write_bytes(path, content)
        for other in self._steps():
            if other not in (path, self._good):
                other.unlink(missing_ok=True)
        self._good = path

    def read(self, most_bytes: int) -> bytes | None:
        """The newest checkpoint that is whole, or None if there are none at all.

        Raises:
            ValueError: if there are some, and none is whole.
        """
        steps, problems = self._steps(), []
        for path in sorted(steps, key=lambda path: steps[path], reverse=True):
            try:
                data = read_limited(path, most_bytes)
                decode(data, path)
            except ValueError as error:
                problems.append(str(error))
                logger.warning("passed over a checkpoint: %s", problems[-1])
                continue
            self._good = path
            return data
        if problems:
            raise ValueError(f"{self.folder}: no checkpoint can be read; {problems[0]}")
        return None

    @property
    def is_begun(self) -> bool:
        """Whether there is any checkpoint, whole or not."""
        return bool(self._steps())

    def _steps(self) -> dict[Path, int]:
        """The number of steps of each file."""
        found = ((path, NAME.fullmatch(path.name)) for path in self.folder.glob("step_*.safetensors"))
        return {path: int(match[1]) for path, match in found if match}


class Checkpoints(Callback):
    """Writes the state of the run into `checkpoints/` of its folder, and continues from there.

    Args:
        every: steps between checkpoints; None for one at the end, or after a signal, only.

    Raises:
        ValueError: for steps that are no whole number above 0.
    """

    is_required = True
    resumes = True

    def __init__(self, every: int | None = 1000) -> None:
        if every is not None:
            check_whole("every", every)
        self.every = every

    def on_train_begin(self, run: Run) -> None:
        """Continue from the newest checkpoint of a run that is to be continued; else keep what a begun one stands at.

        Raises:
            ValueError: if checkpoints are there and none can be read, or it does not fit.
        """
        self._folder = CheckpointFolder(run.folder_for(self) / CHECKPOINTS)
        self._data = fingerprint(run.frames)
        content = self._folder.read(max_bytes(run)) if run.resume else None
        if content is not None:
            restore_run(run, content, self._folder.folder, self._data)
            logger.info("continuing after step %d", run.step)
        elif run.step:  # what was done before this run began is kept, too
            self._folder.save(run.step, encode_run(run, self._data))

    def on_step_end(self, run: Run) -> None:
        """Write a checkpoint when it is time, at the end, and after a signal to stop.

        Raises:
            OSError: if the last one cannot be written; for earlier ones a warning is logged.
            FloatingPointError: if parameters are not finite at the end; before, such a state is not written, and may
                be taken back at the next record.
        """
        is_last = run.ends or run.signal != 0
        if not is_last and (self.every is None or run.step % self.every):
            return
        try:
            if names := not_finite(run.renderer):
                raise FloatingPointError(f"step {run.step}: parameters not finite: {', '.join(names)}")
            self._folder.save(run.step, encode_run(run, self._data))
        except (OSError, FloatingPointError) as error:
            if is_last:
                raise
            logger.warning("step %d: no checkpoint, the last one stays: %s", run.step, error)


def fingerprint(frames: Frames) -> str:
    """A digest of images, poses, times and camera."""
    digest = hashlib.sha256(repr((frames.intrinsics, frames.near, frames.far, frames.background)).encode())
    for tensor in (frames.images, frames.poses, frames.times):
        digest.update(tensor.cpu().contiguous().numpy().data)
    return digest.hexdigest()
