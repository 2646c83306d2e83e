"""A data set's folder, of whatever format: split, timed, placed in the world, read."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from dnerf.core.cameras import PIXEL_OFFSETS, Intrinsics
from dnerf.core.checks import check_choice, check_positive, check_whole
from dnerf.data.background_check import border_color
from dnerf.data.capture import Capture, CaptureFrame
from dnerf.data.formats import read_capture
from dnerf.data.frames import Frames
from dnerf.data.loading import LoadedFrames, check_frames, final_intrinsics, load_frames
from dnerf.data.placing import Given, place, planes_between
from dnerf.data.scene_record import CameraSet, World
from dnerf.data.source import DataSource, NoImages, check_train_end, given_box
from dnerf.data.splits import TIMES, SplitFrames, split_frames

Z_UP = (0.0, 0.0, 1.0)
MASKS = ("empty", "ignored")
PIXELS = 2**20  # looked at together


class FolderData(DataSource):
    """A data set in a folder.

    Frames are in world units, see `dnerf.data.normalization`; what is given here is in the data set's own.

    Args:
        root: the folder.
        resolution: width in pixels after area averaging; None keeps the files' own, at most 400.
        box: (2, 3) corners of what is modelled; "auto" fits them to the training frames.
        format: a reader of `dnerf.data.formats`; "auto" looks at what lies in the folder.
        near: z-depth where rays begin; None finds it.
        far: z-depth where they end; None finds it.
        hold_out: every so many-th frame is the test split where the data set has none; None for no test split.
        times: "auto" takes the files', "order" numbers the frames, "static" is one time for all.
        axes: "opengl" or "opencv", of the cameras; "auto" takes the former and refuses cameras that look away.
        pixel_origin: "center", or "corner" as D-NeRF's code; None takes what the file says, "center" if nothing.
        masks: what lies where a mask is black: "empty" space, or what is "ignored", in training and in scores.
        train_end: train on frames up to this time in [0, 1] only, for extrapolation; None for all.
    """

    def __init__(
        self, root: str | Path, resolution: int | None = None, box: str | Sequence[Sequence[float]] = "auto", *,
        format: str = "auto", near: float | None = None, far: float | None = None, hold_out: int | None = 8,
        times: str = "auto", axes: str = "auto", pixel_origin: str | None = None, masks: str = "empty",
        train_end: float | None = None,
    ) -> None:  # fmt: skip
        check_train_end(train_end)
        if not isinstance(root, str | Path):
            raise ValueError(f"root must be a data set's folder, got {root!r}")
        for name, plane in (("near", near), ("far", far)):
            if plane is not None:
                check_positive(name, plane, allow_zero=name == "near")
        if near is not None and far is not None and near >= far:
            raise ValueError(f"near must be less than far, got {near} and {far}")
        for name, count in (("resolution", resolution), ("hold_out", hold_out)):
            if count is not None:
                check_whole(name, count)
        if pixel_origin is not None:
            check_choice("pixel_origin", pixel_origin, tuple(PIXEL_OFFSETS))
        check_choice("times", times, TIMES)
        check_choice("masks", masks, MASKS)
        self.root, self.resolution, self.train_end = Path(root), resolution, train_end
        self.given = Given(given_box(box), near, far)
        self.format, self.axes, self.pixel_origin = format, axes, pixel_origin
        self.hold_out, self.times, self.masks = hold_out, times, masks
        self._train: LoadedFrames | None = None

    @cached_property
    def capture(self) -> Capture:
        """What the folder's files say; ValueError as `read_capture`."""
        return read_capture(self.root, self.format, axes=self.axes)

    @cached_property
    def _split(self) -> SplitFrames:
        return split_frames(self.capture, self.hold_out, self.times)

    def frames(self, split: str) -> Frames:
        """Read a split; ValueError for what can be wrong with its files, or if it has no images."""
        self._check_split(split)
        world = self.world()
        loaded = self._train if split == "train" and self._train is not None else self._load(split)
        self._train = None
        poses = world.similarity.poses_to_world(_poses(loaded.frames)).float()
        frames = self._made(loaded, poses, planes_between(poses, world))
        if world.has_alpha and not frames.has_alpha and frames.background is None:
            frames = self._on_its_background(frames, split)
        return frames

    def world(self) -> World:
        """How the training frames are placed in the world: as settled, or found from them."""
        if self._world is None:
            self._train = self._load("train")
            self._world = self._placed(self._train)
        return self._world

    def cameras(self) -> dict[str, CameraSet]:
        """See `DataSource.cameras`: of every split, with images or without."""
        similarity, result = self.world().similarity, {}
        for split, frames in self._split.splits.items():
            have_images = any(frame.image is not None for frame in frames)
            if split == "train":
                frames = tuple(f for f in self._read_of(split) if f.image is not None and f.image.path.exists())
            shared: dict[Intrinsics, Intrinsics] = {}
            lenses = (self._lens(final_intrinsics(frame, self.resolution)) for frame in frames)
            result[split] = CameraSet(
                similarity.poses_to_world(_poses(frames)).float(), _times(frames),
                tuple(shared.setdefault(lens, lens) for lens in lenses), tuple(frame.name for frame in frames),
                have_images,
            )  # fmt: skip
        return result

    def check(self, split: str) -> None:
        """Read the files that say where images and cameras are, and look for broken images, see `DataSource.check`."""
        self._check_split(split)
        check_frames(self._read_of(split), resolution=self.resolution)

    def _check_split(self, split: str) -> None:
        super().check(split)
        splits = self._split.splits
        if split not in splits:
            raise NoImages(
                f"{self.capture.path}: there is no {split} split, only {', '.join(splits)}; "
                f"data.hold_out={min(8, len(splits['train']))} makes a test split of training frames, "
                "evaluate_split=null scores none"
            )
        if not any(frame.image is not None for frame in splits[split]):
            raise NoImages(
                f"{self.capture.path}: the {len(splits[split])} cameras of the {split} split have no images: they can "
                "be filmed (render.py path=test), not scored; evaluate_split=null scores none"
            )

    def _read_of(self, split: str) -> list[CaptureFrame]:
        """The frames of a split that have an image; of training, up to `train_end`: nothing else is looked at."""
        frames = [frame for frame in self._split.splits[split] if frame.image is not None]
        if split == "train" and self.train_end is not None:
            frames = [frame for frame in frames if bool(_times([frame])[0] <= self.train_end)]
            if not frames:
                raise ValueError(f"train_end must leave a training frame, got {self.train_end}, the first is later")
        return frames

    def _load(self, split: str) -> LoadedFrames:
        loaded = load_frames(self._read_of(split), resolution=self.resolution, masks=self.masks)
        if split == "train" and not _show_something(loaded.images):
            raise ValueError(
                f"{self.capture.path}: all pixels of the {len(loaded.frames)} training images are alike, they show "
                "nothing: export them again, with what is to be learnt in view"
            )
        return loaded

    def _placed(self, loaded: LoadedFrames) -> World:
        stated = self.capture.up
        if stated is None and self.capture.format == "blender":
            stated = Z_UP  # Blender's, where cameras do not say otherwise
        points = self.capture.points
        if points is not None and not bool(points.isfinite().all(-1).any()):
            points = None
        given = replace(self.given, up=stated, planes=self.capture.planes, points=points)
        world = place(
            lambda poses, planes: self._made(loaded, poses, planes), _poses(loaded.frames), loaded.intrinsics, given
        )
        counts = ", ".join(f"{len(frames)} {split}" for split, frames in self._split.splits.items())
        read = f"{self.capture.path}: read as {self.capture.format}, {counts} frames"
        notes = (read, *self.capture.notes, *self._split.notes, *loaded.notes, *world.notes)
        return replace(world, clock=self._split.clock, has_alpha=loaded.has_alpha, notes=notes)

    def _made(self, loaded: LoadedFrames, poses: Tensor, planes: tuple[float, float]) -> Frames:
        background = None if loaded.has_alpha else self.capture.background
        lenses = [self._lens(lens) for lens in loaded.intrinsics]
        names = tuple(frame.name for frame in loaded.frames)
        return Frames(loaded.images, poses, _times(loaded.frames), lenses, *planes, background, names, loaded.is_known)

    def _lens(self, intrinsics: Intrinsics) -> Intrinsics:
        return intrinsics if self.pixel_origin is None else replace(intrinsics, pixel_origin=self.pixel_origin)

    def _on_its_background(self, frames: Frames, split: str) -> Frames:
        """Opaque frames of a data set whose training images have alpha: what they stand before must be plain."""
        color = border_color(frames)
        if color is None:
            raise ValueError(
                f"{self.capture.path}: images of the {split} split are opaque and show something everywhere, training "
                "images are transparent: they cannot be compared; export both alike"
            )
        red, green, blue = color.tolist()
        return replace(frames, background=(red, green, blue))


def _show_something(images: Tensor) -> bool:
    """Whether any pixel differs from the first; what is larger than memory is read as far as is needed only."""
    pixels = images.flatten(0, -2)
    return any(bool((part != pixels[0]).any()) for part in pixels.split(PIXELS))


def _poses(frames: Sequence[CaptureFrame]) -> Tensor:
    return torch.tensor([frame.pose for frame in frames], dtype=torch.float64)


def _times(frames: Sequence[CaptureFrame]) -> Tensor:
    return torch.tensor([frame.time for frame in frames], dtype=torch.float32)
