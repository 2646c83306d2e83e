"""Callbacks that only tell: a progress bar, and a warning about the box."""

import logging

import torch
from tqdm import tqdm

from dnerf.data.bounds import cut_faces
from dnerf.data.scene_record import SCENE, SceneRecord
from dnerf.samplers import OccupancyAware
from dnerf.training.run import Callback, Run

logger = logging.getLogger(__name__)

WIDER = 1.3  # times the box, that a warning names

BAR = "{percentage:3.0f}% |{bar}| {elapsed}{postfix}"


class ProgressBar(Callback):
    """A progress bar on standard error."""

    def on_train_begin(self, run: Run) -> None:
        """Draw it."""
        self._bar = tqdm(total=100, dynamic_ncols=True, bar_format=BAR)

    def on_step_end(self, run: Run) -> None:
        """Bring it up to date at every record."""
        record = run.record
        if record is None:
            return
        left = f"{record.seconds * (1 - run.progress) / run.progress:.0f} s" if run.progress else "unknown"
        self._bar.n = round(100 * run.progress, 1)
        self._bar.set_postfix_str(
            f"step {record.step:,}, loss {record.losses['loss']:.4f}, PSNR {record.psnr:.2f} dB, "
            f"{run.rays_done / record.seconds:,.0f} rays/s, ETA {left}"
        )

    def on_train_end(self, run: Run) -> None:
        """Leave it as it is."""
        self._bar.close()


class BoxWarning(Callback):
    """Warns at the end, unless there may still be floaters anywhere, if geometry reaches the box."""

    def __init__(self, least_steps: int = 512) -> None:
        self.least_steps = least_steps

    def on_train_end(self, run: Run) -> None:
        """Look at the outer cells that enough views see, unless the background shows what lies beyond the box.

        Samplers that keep no account of cells tell nothing.
        """
        sampler = run.renderer.sampler
        if run.step < self.least_steps or not isinstance(sampler, OccupancyAware):
            return
        if run.renderer.background.shows_beyond:
            return
        faces = cut_faces(sampler.occupied_cells(None), run.frames)
        if faces:
            reached, wider = ", ".join(faces), _wider_box(run)
            logger.warning("geometry reaches the box at %s: what lies beyond is never sampled; %s", reached, wider)


def _wider_box(run: Run) -> str:
    """The setting that gives a box with more room, in the data set's own units, as far as the run knows them."""
    if run.folder is None or not (run.folder / SCENE).exists():
        return "see data.box"
    world = SceneRecord.read(run.folder).world
    low, high = torch.tensor(world.box)
    middle, half = 0.5 * (low + high), 0.5 * WIDER * (high - low)
    corners = world.similarity.box_from_world(torch.stack([middle - half, middle + half])).tolist()
    return f"set data.box=[{','.join('[' + ','.join(f'{x:.4g}' for x in corner) + ']' for corner in corners)}]"
