"""Where frames come from: the door of data sources, and exact scenes."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from numbers import Real

import torch
from torch import Tensor

from dnerf.core.backgrounds import parse_color
from dnerf.core.cameras import Intrinsics
from dnerf.core.checks import as_box, check_choice, check_whole
from dnerf.data.bounds import fit_box
from dnerf.data.capture import SPLITS
from dnerf.data.frames import Frames
from dnerf.data.scene_record import Box, CameraSet, SceneRecord, World
from dnerf.data.synthetic import DNERF_ANGLE_X, random_views, render_frames
from dnerf.scenes import AnalyticScene

DIGITS = 4  # of the longest side, to which a fitted box is rounded, outwards


class NoImages(ValueError):
    """A split that a data set does not have, or of which it has cameras alone."""


class DataSource(ABC):
    """Frames of a scene by split, in the world that models live in."""

    train_end: float | None = None  # last time that training frames may have; None for all
    _world: World | None = None  # as settled, or found

    @abstractmethod
    def frames(self, split: str) -> Frames:
        """Frames of "train", "val" or "test", in world units; ValueError for another split or broken data."""

    @abstractmethod
    def world(self) -> World:
        """Where the scene stands in the world: as settled, else found from the training frames."""

    def settle(self, world: World) -> None:
        """Stand where a run of this scene has its world, rather than find one anew."""
        self._world = world

    @abstractmethod
    def cameras(self) -> dict[str, CameraSet]:
        """Cameras and times of every split, in world units; no pixel is read or rendered."""

    def record(self) -> SceneRecord:
        """What a run keeps of this scene."""
        return SceneRecord(self.world(), self.cameras())

    def check(self, split: str) -> None:
        """Raise what `frames` would of a split, as far as can be seen in little time; `NoImages` if it has none."""
        check_choice("split", split, SPLITS)


def given_box(box: str | Sequence[Sequence[float]]) -> Tensor | None:
    """Corners (2, 3) float64 of a box, None for "auto"; ValueError for anything else."""
    if isinstance(box, str):
        check_choice("box", box, ("auto",))
        return None
    as_box(box)  # checks it
    return torch.as_tensor(box, dtype=torch.float64)


def as_corners(corners: Sequence[Sequence[float]]) -> Box:
    """Two corners as tuples."""
    low, high = corners
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def _rounded(box: Tensor) -> Box:
    """A fitted box with corners that are short to write, rounded outwards."""
    low, high = box.tolist()
    unit = 10.0 ** (math.floor(math.log10(max(high[i] - low[i] for i in range(3)))) + 1 - DIGITS)
    corners = [[math.floor(x / unit) * unit for x in low], [math.ceil(x / unit) * unit for x in high]]
    return as_corners([[float(f"{x:.10g}") for x in corner] for corner in corners])


def check_train_end(train_end: float | None) -> None:
    """Raise ValueError unless a time in [0, 1], or None."""
    if train_end is not None and (not isinstance(train_end, Real) or not 0 <= train_end <= 1):
        raise ValueError(f"train_end must be in [0, 1] or None, got {train_end}")


class SyntheticData(DataSource):
    """Exact frames of an analytic scene: random views of the upper half space, training times evenly over [0, 1].

    Test and validation times are the middles of as many equal parts of the film.

    Args:
        box: (2, 3) corners of what is modelled, in world units; "auto" fits them to the training frames.
        num_train: frames of the train split; likewise num_val and num_test.
        background: colour behind the frames, which have no alpha then; None keeps alpha.
        train_end: train on frames up to this time in [0, 1] only, for extrapolation; None for all.
    """

    def __init__(
        self, scene: AnalyticScene, resolution: int = 200, box: str | Sequence[Sequence[float]] = "auto", *,
        num_train: int = 100, num_val: int = 10, num_test: int = 20, seed: int = 0,
        background: str | Sequence[float] | None = None, train_end: float | None = None,
    ) -> None:  # fmt: skip
        check_train_end(train_end)
        check_whole("resolution", resolution)
        self.num_frames = {"train": num_train, "val": num_val, "test": num_test}
        for split, count in self.num_frames.items():
            check_whole(f"num_{split}", count)
        if not isinstance(scene, AnalyticScene):
            raise ValueError(f"scene must be an exact scene (scene=<name>), got {scene!r}")
        if not isinstance(seed, int):
            raise ValueError(f"seed must be a whole number, got {seed!r}")
        self.scene, self.resolution, self.train_end, self.seed = scene, resolution, train_end, seed
        self._box = given_box(box)
        self._train: Frames | None = None  # rendered to fit the box, and not yet taken
        self.background = None if background is None else parse_color(background)

    def frames(self, split: str) -> Frames:
        """Render a split exactly."""
        check_choice("split", split, SPLITS)
        if split == "train" and self._train is not None:
            frames, self._train = self._train, None
            return frames
        poses, times = self._views(split)
        return render_frames(self.scene, poses, times, self.resolution, background=self.background)

    def world(self) -> World:
        """Exact scenes are made in world units: their similarity is the identity."""
        if self._world is None:
            if self._box is None:
                self._train = self.frames("train")
                box, by = _rounded(fit_box(self._train)), "fitted to the frames"
            else:
                box, by = as_corners(self._box.tolist()), "as given"
            shown = ", ".join("[" + ", ".join(f"{x:g}" for x in corner) + "]" for corner in box)
            note = f"box: [{shown}], {by}"
            self._world = World(box, has_alpha=self.background is None, notes=(note,))
        return self._world

    def cameras(self) -> dict[str, CameraSet]:
        """See `DataSource.cameras`."""
        lens = Intrinsics.from_angle(self.resolution, self.resolution, DNERF_ANGLE_X)
        views = {split: self._views(split) for split in SPLITS}
        return {split: CameraSet(poses, times, (lens,) * len(times)) for split, (poses, times) in views.items()}

    def _views(self, split: str) -> tuple[Tensor, Tensor]:
        """Poses and times of a split; of training up to `train_end`, which leaves the first, at 0, in any case."""
        seed = self.seed + 1000 * SPLITS.index(split)
        poses, times = random_views(self.num_frames[split], midway=split != "train", seed=seed)
        if split == "train" and self.train_end is not None:
            return poses[times <= self.train_end], times[times <= self.train_end]
        return poses, times
