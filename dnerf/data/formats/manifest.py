"""`transforms*.json`: what its frames say, in every dialect that NeRF's tools write."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from dnerf.core.cameras import Intrinsics
from dnerf.data.capture import CaptureFrame, ImageFile
from dnerf.data.formats import json_files as files
from dnerf.data.formats.folder import Folder
from dnerf.data.formats.keys import TIME_KEYS, check_keys
from dnerf.data.formats.manifest_cameras import LensFields
from dnerf.data.formats.points import read_ply
from dnerf.data.formats.poses import Pose, rigid_pose
from dnerf.data.images import read_header

MAX_TIME = 1e20  # nanoseconds since 1970 are 2e18
Size = tuple[int, int]


class Manifest:
    """One `transforms*.json` of a folder, read and checked but for its images' contents.

    Args:
        folder: where images lie, and where notes go.
        path: the file.

    Raises:
        ValueError: in one line that names file and field, for anything missing, malformed or out of range.
    """

    def __init__(self, folder: Folder, path: Path) -> None:
        self.folder, self.path = folder, path
        self.fields = files.read_object(path)
        listed = self.fields.pop("frames", None)
        if not isinstance(listed, list) or not listed:
            raise ValueError(f"{path}: frames must be a list with at least one frame, got {files.short(listed)}")
        if len(listed) > files.MAX_FRAMES:
            raise ValueError(f"{path}: frames must be at most {files.MAX_FRAMES}, got {len(listed)}")
        check_keys(self.fields, str(path), folder.notes, path.name, of_frame=False)
        for index, frame in enumerate(listed):
            if not isinstance(frame, dict):
                raise ValueError(f"{self._where(index)} must be an object, got {files.short(frame)}")
            check_keys(frame, self._where(index), folder.notes, path.name, of_frame=True)
        self.listed: list[dict[str, Any]] = listed

    def frames(self, *, cameras_only: bool = False, size: Size | None = None) -> tuple[CaptureFrame, ...]:
        """The frames, in the file's order.

        Args:
            cameras_only: whether images may be missing altogether, as those of a test split may.
            size: width and height of cameras that have neither an image nor a stated size.
        """
        images = [self._image(index, cameras_only) for index in range(len(self.listed))]
        there = [found is not None and found[1] for found in images]
        if not any(there):
            if not cameras_only:
                first = next(found[0] for found in images if found)
                other = self.folder.other_kind(first)
                said = "put them there, or correct file_path"
                raise ValueError(
                    f"{self.path}: none of its {len(images)} images is there, the first is {first}; "
                    + (said if other is None else f"there is {other.name}: convert them to PNG or JPEG")
                )
            self.folder.notes.add(f"{self.path.name}: none of its {len(images)} images is there, only cameras are read")
        times = self._times()
        sizes = [read_header(found[0])[:2] if found and there[index] else None for index, found in enumerate(images)]
        size = next((s for s in sizes if s is not None), size)
        intrinsics: dict[Intrinsics, Intrinsics] = {}  # equal ones are kept once
        frames = []
        for index, (found, fields) in enumerate(zip(images, self.listed)):
            lens = LensFields(fields, self.fields, self._where(index), str(self.path))
            own_size = lens.stated_size() or sizes[index] or size
            if own_size is None:
                raise ValueError(f"{self.path}: w and h must be given, or an image be there, to know the images' size")
            camera = lens.intrinsics(*own_size)
            camera = intrinsics.setdefault(camera, camera)
            image = ImageFile(found[0]) if found and any(there) else None
            name = self.folder.name(found[0]) if found else f"frame_{index:05d}"
            frames.append(CaptureFrame(name, self._pose(index), camera, image, self._mask(index), times[index]))
        return uniquely_named(frames)

    def planes(self) -> tuple[float, float] | None:
        """z-depths near and far, if the file states both."""
        if (self.fields.get("near") is None) != (self.fields.get("far") is None):
            self.folder.notes.add(f"{self.path.name}: near and far are used together only, one is not given")
        return stated_planes(self.fields, self.path)

    def background(self) -> tuple[float, float, float] | None:
        """What opaque images show behind the scene, if the file says."""
        return color(self.fields.get("background"), f"{self.path}: background")

    def up(self) -> tuple[float, float, float] | None:
        """The direction that is up, if the file says."""
        return direction(self.fields.get("up"), f"{self.path}: up")

    def _where(self, index: int) -> str:
        return f"{self.path}: frames[{index}]"

    def _image(self, index: int, cameras_only: bool) -> tuple[Path, bool] | None:
        frame, where = self.listed[index], self._where(index)
        if cameras_only and frame.get("file_path") is None:
            return None
        return self.folder.image(files.required(frame, "file_path", where), f"{where}.file_path")

    def _mask(self, index: int) -> Path | None:
        value, where = self.listed[index].get("mask_path"), f"{self._where(index)}.mask_path"
        if value is None:
            return None
        path, exists = self.folder.image(value, where)
        if not exists:
            raise ValueError(f"{where}: no mask {path}; put it there, or remove mask_path from the frames")
        return path

    def _pose(self, index: int) -> Pose:
        where = f"{self._where(index)}.transform_matrix"
        values = files.matrix(
            files.required(self.listed[index], "transform_matrix", self._where(index)), where, ((4, 4), (3, 4))
        )
        return rigid_pose(values, where, self.path.name, self.folder.notes)

    def _times(self) -> Sequence[float | None]:
        """Each frame's time by the file's clock, or None for all."""
        for key in TIME_KEYS:
            values = [frame.get(key) for frame in self.listed]
            if all(value is None for value in values):
                continue
            if any(value is None for value in values):
                missing = next(i for i, value in enumerate(values) if value is None)
                raise ValueError(
                    f"{self._where(missing)}.{key} is missing, other frames have it; give it to all, or to none"
                )
            return [files.number(v, f"{self._where(i)}.{key}", -MAX_TIME, MAX_TIME) for i, v in enumerate(values)]
        return [None] * len(self.listed)


def stated_planes(fields: Mapping[str, Any], path: Path, scale: float = 1.0) -> tuple[float, float] | None:
    """z-depths near and far of a file's fields, divided by a scale; None unless both are there."""
    stated = [
        files.number(fields[key], f"{path}: {key}", 0) / scale for key in ("near", "far") if fields.get(key) is not None
    ]
    if len(stated) < 2:
        return None
    near, far = stated
    if not near < far <= files.MAX_NUMBER:
        raise ValueError(f"{path}: near must be less than far, got {near:g} and {far:g}; correct or remove them")
    return near, far


def color(value: Any, where: str) -> tuple[float, float, float] | None:
    """Three numbers in [0, 1], or None; ValueError for anything else."""
    if value is None:
        return None
    red, green, blue = files.numbers(value, where, 3, 0, 1)
    return red, green, blue


def direction(value: Any, where: str) -> tuple[float, float, float] | None:
    """A unit vector along three numbers, or None; ValueError for anything else, or no length."""
    if value is None:
        return None
    vector = np.array(files.numbers(value, where, 3))
    length = float(np.linalg.norm(vector))
    if not length > 1e-6:
        raise ValueError(f"{where} must have a length, got {files.short(value)}")
    x, y, z = (vector / length).tolist()
    return x, y, z


def uniquely_named(frames: Sequence[CaptureFrame]) -> tuple[CaptureFrame, ...]:
    """The same frames; names that occur again get a number."""
    counts: dict[str, int] = {}
    result: dict[str, CaptureFrame] = {}
    for frame in frames:
        name = frame.name
        while name in result:
            counts[frame.name] = counts.get(frame.name, 1) + 1
            name = f"{frame.name}#{counts[frame.name]}"
        result[name] = replace(frame, name=name)
    return tuple(result.values())


def merged(values: Mapping[str, Any], path: Path, key: str) -> Any:
    """What several files of one data set say, which must be the same where two say something."""
    said = {name: value for name, value in values.items() if value is not None}
    if len(set(said.values())) > 1:
        raise ValueError(
            f"{path}: {key} must be the same in all files, got "
            + ", ".join(f"{value} in {name}" for name, value in said.items())
            + "; correct one, or remove it"
        )
    return next(iter(said.values()), None)


def named_points(manifest: Manifest) -> Tensor | None:
    """The sparse points that `ply_file_path` names; with a note, none where they cannot be read."""
    value = manifest.fields.get("ply_file_path")
    if value is None:
        return None
    where = f"{manifest.path}: ply_file_path"
    path = manifest.folder.root / files.text(value, where).replace("\\", "/")
    try:
        return read_ply(manifest.folder.inside(path, where))
    except ValueError as error:
        manifest.folder.notes.add(f"{manifest.path.name}: sparse points were not read: {error}")
        return None
