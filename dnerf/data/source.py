"""Where frames come from: a folder in D-NeRF's format, or an analytic scene."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from numbers import Real
from pathlib import Path

from torch import Tensor

from dnerf.core.backgrounds import parse_color
from dnerf.core.checks import as_box, check_choice, check_positive, check_whole
from dnerf.data.bounds import fit_box
from dnerf.data.formats.legacy import check_blender, has_transparency, load_blender
from dnerf.data.frames import Frames
from dnerf.data.synthetic import random_views, render_frames
from dnerf.scenes import AnalyticScene

SPLITS = ("train", "val", "test")
DIGITS = 4  # of the longest side, to which a fitted box is rounded, outwards


class DataSource(ABC):
    """Frames of a scene by split, and the box that is modelled."""

    box: Tensor | None  # (2, 3), in world units; None fits it to the training frames
    train_end: float | None = None  # last time that training frames may have; None for all

    @abstractmethod
    def frames(self, split: str) -> Frames:
        """Frames of "train", "val" or "test"; ValueError for another split or broken data."""

    def fitted_box(self, frames: Frames) -> list[list[float]]:
        """Lowest and highest corner of what is modelled: as given, or fitted to the training frames, see `fit_box`."""
        if self.box is not None:
            return self.box.tolist()
        low, high = fit_box(frames).tolist()
        unit = 10.0 ** (math.floor(math.log10(max(high[i] - low[i] for i in range(3)))) + 1 - DIGITS)
        corners = [[math.floor(x / unit) * unit for x in low], [math.ceil(x / unit) * unit for x in high]]
        return [[float(f"{x:.10g}") for x in corner] for corner in corners]

    def check(self, split: str) -> None:
        """Raise what `frames` would of a split that is not there, or is broken as far as can be seen in no time."""
        check_choice("split", split, SPLITS)

    def _known(self, frames: Frames, split: str) -> Frames:
        """The frames of a split that may be seen: training frames up to `train_end`, all others whole."""
        if split != "train" or self.train_end is None:
            return frames
        kept = (frames.times <= self.train_end).nonzero()[:, 0].tolist()
        if not kept:
            raise ValueError(f"train_end must leave a training frame, got {self.train_end}, the first is later")
        return frames.subset(kept)


def _given_box(box: str | Sequence[Sequence[float]]) -> Tensor | None:
    if isinstance(box, str):
        check_choice("box", box, ("auto",))
        return None
    return as_box(box)


def _check_train_end(train_end: float | None) -> None:
    if train_end is not None and (not isinstance(train_end, Real) or not 0 <= train_end <= 1):
        raise ValueError(f"train_end must be in [0, 1] or None, got {train_end}")


class BlenderData(DataSource):
    """A scene folder in D-NeRF's format.

    If no pixel of the training images is transparent, no split has alpha, whatever the files' headers say.

    Args:
        root: folder that holds `transforms_<split>.json`.
        resolution: width in pixels after area averaging; None keeps the files' size.
        box: (2, 3) corners of what is modelled, in world units; "auto" fits them to the training frames.
        near: z-depth where rays begin; None takes what the file says, 2 if nothing.
        far: z-depth where they end; None takes what the file says, 6 if nothing.
        pixel_origin: "center", or "corner" as D-NeRF's code; None takes what the file says, "center" if nothing.
        train_end: train on frames up to this time in [0, 1] only, for extrapolation; None for all.
    """

    def __init__(
        self,
        root: str,
        resolution: int | None = 400,
        box: str | Sequence[Sequence[float]] = "auto",
        *,
        near: float | None = None,
        far: float | None = None,
        pixel_origin: str | None = None,
        train_end: float | None = None,
    ) -> None:
        _check_train_end(train_end)
        if not isinstance(root, str | Path):
            raise ValueError(f"root must be a data set's folder, got {root!r}")
        for name, plane in (("near", near), ("far", far)):
            if plane is not None:
                check_positive(name, plane, allow_zero=name == "near")
        self.root, self.resolution, self.box, self.train_end = root, resolution, _given_box(box), train_end
        self.near, self.far, self.pixel_origin = near, far, pixel_origin

    def frames(self, split: str) -> Frames:
        """Read a split; see `load_blender` for what can be wrong with it."""
        check_choice("split", split, SPLITS)
        frames = load_blender(
            self.root, split, self.resolution, near=self.near, far=self.far, pixel_origin=self.pixel_origin,
            has_alpha=self._has_alpha,
        )  # fmt: skip
        return self._known(frames, split)

    @cached_property
    def _has_alpha(self) -> bool | None:
        """Whether training images are transparent somewhere; None without them, where each split goes by its own."""
        return has_transparency(self.root) if (Path(self.root) / "transforms_train.json").exists() else None

    def check(self, split: str) -> None:
        """Read a split's file and its images' headers, see `DataSource.check`."""
        super().check(split)
        check_blender(self.root, split)


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
        self,
        scene: AnalyticScene,
        resolution: int = 200,
        box: str | Sequence[Sequence[float]] = "auto",
        *,
        num_train: int = 100,
        num_val: int = 10,
        num_test: int = 20,
        seed: int = 0,
        background: str | Sequence[float] | None = None,
        train_end: float | None = None,
    ) -> None:
        _check_train_end(train_end)
        check_whole("resolution", resolution)
        self.num_frames = {"train": num_train, "val": num_val, "test": num_test}
        for split, count in self.num_frames.items():
            check_whole(f"num_{split}", count)
        if not isinstance(scene, AnalyticScene):
            raise ValueError(f"scene must be an exact scene (scene=<name>), got {scene!r}")
        if not isinstance(seed, int):
            raise ValueError(f"seed must be a whole number, got {seed!r}")
        self.scene, self.resolution, self.box, self.train_end = scene, resolution, _given_box(box), train_end
        self.seed = seed
        self.background = None if background is None else parse_color(background)

    def frames(self, split: str) -> Frames:
        """Render a split exactly."""
        check_choice("split", split, SPLITS)
        seed = self.seed + 1000 * SPLITS.index(split)
        poses, times = random_views(self.num_frames[split], midway=split != "train", seed=seed)
        return self._known(render_frames(self.scene, poses, times, self.resolution, background=self.background), split)
