"""Captures of Nerfies, HyperNeRF and DyCheck: `dataset.json`, `camera/*.json`, `rgb/*x/*.png`.

Source: https://github.com/google/nerfies#datasets; `extra.json` is DyCheck's (Gao et al. 2022).
"""

import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dnerf.core.cameras import Intrinsics
from dnerf.core.lenses import Distortion
from dnerf.data.capture import Capture, CaptureFrame, ImageFile
from dnerf.data.formats import json_files as files
from dnerf.data.formats.folder import Folder, frame_numbers
from dnerf.data.formats.manifest import direction, stated_planes
from dnerf.data.formats.manifest_cameras import MAX_COEFFICIENT, MAX_FOCAL_RATIO, MAX_SIDE, MAX_SKEW
from dnerf.data.formats.points import as_points, read_npy
from dnerf.data.formats.poses import Pose, from_opencv, rigid_pose

SPLITS = {"train": "train_ids", "test": "val_ids"}  # what the papers score is called val
TIMES = ("time_id", "warp_id")


def recognises(root: Path) -> bool:
    """Whether a folder holds `dataset.json` and `camera/`."""
    return (root / "dataset.json").exists() and (root / "camera").is_dir()


def read(root: Path) -> Capture:
    """What the files say; `val_ids` become the test split.

    Positions and planes are those of the camera files, before `scene.json` scales and moves them.

    Raises:
        ValueError: in one line that names file and field, for anything missing, malformed or out of range.
    """
    notes = files.Notes()
    folder = Folder(root, notes)
    ids_by_split = _ids(root / "dataset.json")
    ids = [name for names in ids_by_split.values() for name in names]
    images, suffix = _images(folder, ids)
    times = dict(zip(ids, _times(root / "metadata.json", ids_by_split, notes)))
    cameras = {name: _camera(root / "camera" / f"{name}.json", notes) for name in ids}
    splits = {
        split: tuple(
            CaptureFrame(
                name, *cameras[name], ImageFile(folder.inside(images / f"{name}{suffix}", name)), None, times[name]
            )
            for name in names
        )
        for split, names in ids_by_split.items()
    }
    points, extra = root / "points.npy", root / "extra.json"
    return Capture(
        root, "nerfies", splits, planes=_planes(root / "scene.json"), notes=notes.lines(),
        points=as_points(read_npy(points), str(points)) if points.exists() else None,
        up=direction(files.read_object(extra).get("up"), f"{extra}: up") if extra.exists() else None,
    )  # fmt: skip


def _ids(path: Path) -> dict[str, list[str]]:
    """Names of frames by split; one split "all" where the file names none for training."""
    fields = files.read_object(path)
    found = {split: _names(fields.get(key), f"{path}: {key}") for split, key in SPLITS.items()}
    if not found["train"]:
        found = {"all": _names(files.required(fields, "ids", str(path)), f"{path}: ids")}
        if not found["all"]:
            raise ValueError(f"{path}: ids must name at least one frame, got none")
    return {split: names for split, names in found.items() if names}


def _names(value: Any, where: str) -> list[str]:
    if value is None:
        return []
    if not isinstance(value, list) or len(value) > files.MAX_FRAMES:
        raise ValueError(f"{where} must be a list of at most {files.MAX_FRAMES} names, got {files.short(value)}")
    for index, name in enumerate(value):
        # Names become paths.
        if not isinstance(name, str) or not re.fullmatch(r"\w[\w.-]{0,200}", name):
            raise ValueError(f"{where}[{index}] must be a plain name such as 000001, got {files.short(name)}")
    return list(dict.fromkeys(value))


def _images(folder: Folder, ids: Sequence[str]) -> tuple[Path, str]:
    """The folder of the largest images, and their suffix."""
    scales = []
    for path in (folder.root / "rgb").glob("*x"):
        if re.fullmatch(r"[0-9]{1,4}x", path.name) and path.is_dir():
            scales.append((int(path.name[:-1]), path))
    for _, path in sorted(scales):
        for suffix in (".png", ".jpg", ".jpeg", ".PNG", ".JPG"):
            if any((path / f"{name}{suffix}").is_file() for name in ids):
                return folder.inside(path, str(path)), suffix
    raise ValueError(
        f"{folder.root}: no image of dataset.json is there, looked for rgb/1x/{ids[0]}.png and rgb/2x, 4x, ..."
    )


def _times(path: Path, ids_by_split: Mapping[str, Sequence[str]], notes: files.Notes) -> Sequence[float | None]:
    """Times of all frames: numbers in their names, or what `metadata.json` numbers them by where names disagree.

    Frames for validation carry the embedding of a neighbour in `metadata.json`, but their own number in the name.
    """
    ids = [name for names in ids_by_split.values() for name in names]
    by_name = frame_numbers(ids)
    metadata = files.read_object(path) if path.exists() else {}
    for key in TIMES:
        if not all(isinstance(metadata.get(name), dict) and key in metadata[name] for name in ids):
            continue
        stated = [files.number(metadata[name][key], f"{path}: {name}.{key}") for name in ids]
        first = len(next(iter(ids_by_split.values())))
        if by_name is not None and _same_order(by_name[:first], stated[:first]):
            break
        return stated
    if by_name is None:
        notes.add("dataset.json: neither metadata.json nor names number the frames, they have no time")
        return [None] * len(ids)
    return by_name


def _same_order(left: Sequence[float], right: Sequence[float]) -> bool:
    """Whether one is a strictly increasing function of the other."""
    pairs = sorted(set(zip(left, right)))
    return all(a < b and c < d for (a, c), (b, d) in itertools.pairwise(pairs))


def _camera(path: Path, notes: files.Notes) -> tuple[Pose, Intrinsics]:
    """Pose and intrinsics of one camera file; its orientation is world to camera, with OpenCV's axes."""
    fields = files.read_object(path)

    def found(key: str, default: Any) -> Any:
        return default if fields.get(key) is None else fields[key]

    for key in ("orientation", "position", "focal_length", "principal_point", "image_size"):
        files.required(fields, key, str(path))
    size = fields["image_size"]
    if not isinstance(size, list) or len(size) != 2:
        raise ValueError(f"{path}: image_size must be a list of width and height, got {files.short(size)}")
    width, height = (files.whole(x, f"{path}: image_size[{i}]", 1, MAX_SIDE) for i, x in enumerate(size))
    focal = files.number(
        fields["focal_length"], f"{path}: focal_length", width / MAX_FOCAL_RATIO, width * MAX_FOCAL_RATIO
    )
    aspect = files.number(found("pixel_aspect_ratio", 1.0), f"{path}: pixel_aspect_ratio", 1e-2, 1e2)
    if abs(files.number(found("skew", 0.0), f"{path}: skew")) > MAX_SKEW * focal:
        raise ValueError(f"{path}: skew must be 0, got {fields['skew']:g}: pixels without skew are supported only")
    center = files.numbers(fields["principal_point"], f"{path}: principal_point", 2, -100 * MAX_SIDE, 100 * MAX_SIDE)
    radial = files.numbers(
        found("radial_distortion", [0, 0, 0]), f"{path}: radial_distortion", 3, -MAX_COEFFICIENT, MAX_COEFFICIENT
    )
    tangential = files.numbers(
        found("tangential_distortion", found("tangential", [0, 0])), f"{path}: tangential_distortion", 2,
        -MAX_COEFFICIENT, MAX_COEFFICIENT,
    )  # fmt: skip
    distorted = any(radial) or any(tangential)
    try:
        distortion = Distortion("opencv", tuple(radial), (tangential[0], tangential[1])) if distorted else None
        intrinsics = Intrinsics(width, height, focal, focal * aspect, center[0], center[1], distortion=distortion)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    pose = np.eye(4)
    pose[:3, :3] = files.matrix(fields["orientation"], f"{path}: orientation", ((3, 3),)).T
    pose[:3, 3] = files.numbers(fields["position"], f"{path}: position", 3)
    return rigid_pose(from_opencv(pose), f"{path}: orientation", "camera/", notes), intrinsics


def _planes(path: Path) -> tuple[float, float] | None:
    """Near and far of `scene.json`, in the units of the camera files; they were estimated as z-depths of points."""
    if not path.exists():
        return None
    fields = files.read_object(path)
    scale = files.number(fields.get("scale", 1.0), f"{path}: scale", 1 / files.MAX_NUMBER, files.MAX_NUMBER)
    return stated_planes(fields, path, scale)
