"""Readers and writers, one module for each file format: a folder of others becomes a `Capture`."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dnerf.core.checks import check_choice
from dnerf.data.capture import Capture
from dnerf.data.formats import blender, colmap, llff, nerfies, rig, transforms
from dnerf.data.formats.axes import check_axes
from dnerf.data.formats.poses import as_pose, from_opencv

AXES = ("auto", "opengl", "opencv")
MAX_SUBFOLDERS = 200
LISTING_SUFFIXES = (".json", ".npy", ".bin", ".txt")
PACKED = (".zip", ".tar", ".gz", ".tgz", ".7z", ".rar")
POSES = "images and films alone do not say where cameras stood: scripts/capture.py, or ns-process-data, finds out"


@dataclass(frozen=True)
class Format:
    """How the files of one format are recognised and read."""

    recognises: Callable[[Path], bool]
    read: Callable[[Path], Capture]  # with a pose's axes as the files have them, where they may differ
    looks_for: str  # what must lie in the folder
    fixed_axes: bool  # whether the format says what a pose's axes are, so that nobody writes others


# The first that recognises a folder reads it: what says most of its cameras and times comes first.
FORMATS = {
    "blender": Format(blender.recognises, blender.read, "transforms_train.json", fixed_axes=False),
    "transforms": Format(transforms.recognises, transforms.read, "transforms.json", fixed_axes=False),
    "nerfies": Format(nerfies.recognises, nerfies.read, "dataset.json and camera/", fixed_axes=True),
    "llff": Format(llff.recognises, llff.read, "poses_bounds.npy", fixed_axes=True),
    "rig": Format(rig.recognises, rig.read, "info.json and videos", fixed_axes=False),
    "colmap": Format(colmap.recognises, colmap.read, "sparse/0/cameras.bin or cameras.txt", fixed_axes=True),
}


def read_capture(root: str | Path, format: str = "auto", *, axes: str = "auto") -> Capture:
    """What a data set's files say of its frames, in the files' own units, axes made OpenGL's.

    Args:
        root: the data set's folder, or the file in it that lists its frames.
        format: one of `FORMATS`; "auto" takes the first that recognises the folder.
        axes: "opengl" or "opencv" (x right, y down, z forward), of matrices in formats that leave it open;
            "auto" refuses what looks like the wrong one.

    Raises:
        ValueError: in one line that names file and field and how to go on, for anything that cannot be read.
    """
    check_choice("format", format, ("auto", *FORMATS))
    check_choice("axes", axes, AXES)
    if not isinstance(root, str | Path) or "\0" in str(root):
        raise ValueError(f"root must be a data set's folder, got {root!r}")
    root = Path(root).expanduser()
    if os.path.isfile(root):
        if root.suffix not in LISTING_SUFFIXES:
            said = "unpack it" if root.suffix in PACKED else POSES
            raise ValueError(f"root must be a data set's folder, got the file {root}; {said}")
        root = root.parent
    if not os.path.isdir(root):
        raise ValueError(f"root must be a data set's folder, got {root}")
    try:
        return _read(root, format, axes)
    except OSError as error:
        raise ValueError(f"{root}: cannot be read: {error}") from error


def _read(root: Path, format: str, axes: str) -> Capture:
    found = [name for name, reader in FORMATS.items() if reader.recognises(root)]
    if format == "auto" and not found:
        raise ValueError(_not_recognised(root))
    name = found[0] if format == "auto" else format
    reader = FORMATS[name]
    if reader.fixed_axes and axes == "opencv":
        raise ValueError(f"axes must be auto or opengl: the format {name} says what a pose's axes are, got opencv")
    capture = reader.read(root)
    if axes == "opencv":
        splits = {
            split: tuple(replace(f, pose=as_pose(from_opencv(np.array(f.pose)))) for f in frames)
            for split, frames in capture.splits.items()
        }
        capture = replace(capture, splits=splits)
    elif axes == "auto" and not reader.fixed_axes:
        check_axes(capture)
    others = [other for other in found if other != name]
    if others and format == "auto":
        note = f"{root}: read as {name}; it could be read with data.format={' or '.join(others)}, too"
        capture = replace(capture, notes=(note, *capture.notes))
    return capture


def _not_recognised(root: Path) -> str:
    """What to say of a folder that no reader knows, and where a data set lies instead, if just below."""
    wanted = ", ".join(f"{reader.looks_for} ({name})" for name, reader in FORMATS.items())
    below = [path for path in sorted(root.iterdir())[:MAX_SUBFOLDERS] if path.is_dir()]
    known = [path.name for path in below if any(reader.recognises(path) for reader in FORMATS.values())]
    hint = f"; but {known[0]!r} below it is one" if known else f"; {POSES}"
    return f"{root}: no data set is recognised, none of {wanted} lies there{hint}"
