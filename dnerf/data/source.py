"""Where frames come from: a folder in D-NeRF's format, or an analytic scene."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from numbers import Real
from pathlib import Path

from torch import Tensor

from dnerf.backgrounds import parse_color
from dnerf.checks import as_box, check_choice, check_positive, check_whole
from dnerf.data.blender import check_blender, load_blender
from dnerf.data.frames import Frames
from dnerf.data.synthetic import random_views, render_frames
from dnerf.scenes import AnalyticScene

SPLITS = ("train", "val", "test")


class DataSource(ABC):
    """Frames of a scene by split, and the box its matter lies in."""

    box: Tensor  # (2, 3), in world units
    train_end: float | None = None  # last time that training frames may have; None for all

    @abstractmethod
    def frames(self, split: str) -> Frames:
        """Frames of "train", "val" or "test".

        Raises:
            ValueError: for another split or broken data.
        """

    def check(self, split: str) -> None:
        """Raise what `frames` would of a split that is not there, or is broken as far as can be seen in no time.

        Raises:
            ValueError: for another split or broken data.
        """
        check_choice("split", split, SPLITS)

    def _known(self, frames: Frames, split: str) -> Frames:
        """The frames of a split that may be seen: training frames up to `train_end`, all others whole.

        Raises:
            ValueError: if no training frame is left.
        """
        if split != "train" or self.train_end is None:
            return frames
        kept = (frames.times <= self.train_end).nonzero()[:, 0].tolist()
        if not kept:
            raise ValueError(f"train_end must leave a training frame, got {self.train_end}, the first is later")
        return frames.subset(kept)


def _check_train_end(train_end: float | None) -> None:
    if train_end is None:
        return
    if not isinstance(train_end, Real) or not 0 <= train_end <= 1:
        raise ValueError(f"train_end must be in [0, 1] or None, got {train_end}")


class BlenderData(DataSource):
    """A scene folder in D-NeRF's format.

    Args:
        root: folder that holds `transforms_<split>.json`.
        resolution: width in pixels after area averaging; None keeps the files' size.
        box: (2, 3) corners of what is modelled, in world units.
        near: z-depth where rays begin; None takes what the file says, 2 if nothing.
        far: z-depth where they end; None takes what the file says, 6 if nothing.
        pixel_origin: "center", or "corner" as D-NeRF's code; None takes what the file says, "center" if nothing.
        train_end: train on frames up to this time only, for extrapolation; None for all.

    Raises:
        ValueError: for a box that is none or a time outside [0, 1].
    """

    def __init__(
        self,
        root: str,
        resolution: int | None = 400,
        box: Sequence[Sequence[float]] = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5)),
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
        self.train_end = train_end
        self.root = root
        self.resolution = resolution
        self.box = as_box(box)
        self.near = near
        self.far = far
        self.pixel_origin = pixel_origin

    def frames(self, split: str) -> Frames:
        """Read a split; see `load_blender` for what can be wrong with it."""
        check_choice("split", split, SPLITS)
        frames = load_blender(
            self.root, split, self.resolution, near=self.near, far=self.far, pixel_origin=self.pixel_origin
        )
        return self._known(frames, split)

    def check(self, split: str) -> None:
        """Read a split's file and its images' headers, see `DataSource.check`."""
        super().check(split)
        check_blender(self.root, split)


class SyntheticData(DataSource):
    """Exact frames of an analytic scene: random views of the upper half space, training times evenly over [0, 1].

    Test and validation times are the middles of as many equal parts of the film.

    Args:
        scene: what is rendered.
        resolution: width and height in pixels.
        box: (2, 3) corners of what is modelled, in world units.
        num_train: frames of the train split.
        num_val: frames of the val split.
        num_test: frames of the test split.
        seed: of the random views.
        background: colour behind the frames, which have no alpha then; None keeps alpha.
        train_end: train on frames up to this time only, for extrapolation; None for all.

    Raises:
        ValueError: if resolution or a number of frames is not positive, the box or colour is none, or a time lies
            outside [0, 1].
    """

    def __init__(
        self,
        scene: AnalyticScene,
        resolution: int = 200,
        box: Sequence[Sequence[float]] = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5)),
        *,
        num_train: int = 100,
        num_val: int = 10,
        num_test: int = 20,
        seed: int = 0,
        background: str | Sequence[float] | None = None,
        train_end: float | None = None,
    ) -> None:
        _check_train_end(train_end)
        for name, value in (
            ("resolution", resolution),
            ("num_train", num_train),
            ("num_val", num_val),
            ("num_test", num_test),
        ):
            check_whole(name, value)
        if not isinstance(scene, AnalyticScene):
            raise ValueError(f"scene must be an exact scene (scene=<name>), got {scene!r}")
        if not isinstance(seed, int):
            raise ValueError(f"seed must be a whole number, got {seed!r}")
        self.train_end = train_end
        self.scene = scene
        self.resolution = resolution
        self.box = as_box(box)
        self.num_frames = {"train": num_train, "val": num_val, "test": num_test}
        self.seed = seed
        self.background = None if background is None else parse_color(background)

    def frames(self, split: str) -> Frames:
        """Render a split exactly."""
        check_choice("split", split, SPLITS)
        poses, times = random_views(
            self.num_frames[split], midway=split != "train", seed=self.seed + 1000 * SPLITS.index(split)
        )
        return self._known(render_frames(self.scene, poses, times, self.resolution, background=self.background), split)
