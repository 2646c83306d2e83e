"""What a data set's files say, as they say it: posed frames in the file's own units, axes and clock.

A reader (`dnerf.data.formats`) makes a `Capture` of a folder. Nothing is decoded, scaled or guessed here: normalising,
splitting and reading pixels come afterwards and are the same for every format.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from dnerf.core.cameras import Intrinsics

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class ImageFile:
    """Where an image lies: a file, or one frame of a video."""

    path: Path
    frame: int | None = None  # index in a video, from 0; None for an image file


@dataclass(frozen=True)
class CaptureFrame:
    """One frame of a capture."""

    name: str  # for messages and files, unique within its split
    pose: tuple[tuple[float, ...], ...]  # 4 x 4, camera to world, OpenGL axes, in the file's units
    intrinsics: Intrinsics  # at the size that the file means, or the image's own
    image: ImageFile | None = None  # None for a camera without an image
    mask: Path | None = None  # image file: white is kept, black is none of the scene
    time: float | None = None  # by the file's own clock; None if it says nothing


@dataclass(frozen=True)
class Capture:
    """What a folder holds; everything in the file's units."""

    path: Path  # the file, or folder, that messages name
    format: str  # the reader's name
    splits: Mapping[str, tuple[CaptureFrame, ...]]  # "train", "val", "test"; one "all" where the format has no splits
    planes: tuple[float, float] | None = None  # z-depths near and far, where the file states both
    background: tuple[float, float, float] | None = None  # behind opaque images, where the file states it
    points: Tensor | None = None  # (N, 3) float32 sparse points on surfaces
    up: tuple[float, float, float] | None = None  # where the format fixes it
    notes: tuple[str, ...] = ()  # repairs made and keys not known, a line each
