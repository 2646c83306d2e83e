"""`poses_bounds.npy` of LLFF (Mildenhall et al. 2019), with images, or a folder or video of each camera.

A row holds a 3 x 5 matrix (axes down, right, back; position; height, width, focal length) and near and far. With videos
or folders it is that of Neural 3D Video (Li et al. 2022), one row for each camera.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dnerf.core.cameras import Intrinsics
from dnerf.data.capture import Capture, CaptureFrame, ImageFile
from dnerf.data.formats.folder import IMAGE_SUFFIXES, VIDEO_SUFFIXES, Folder, frame_numbers
from dnerf.data.formats.json_files import MAX_FRAMES, MAX_NUMBER, Notes, number, whole
from dnerf.data.formats.manifest import uniquely_named
from dnerf.data.formats.manifest_cameras import MAX_FOCAL_RATIO, MAX_SIDE
from dnerf.data.formats.points import read_npy
from dnerf.data.formats.poses import rigid_pose
from dnerf.data.videos import read_video_header

MAX_BYTES = 2**24
IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8")
Images = list[tuple[ImageFile, float | None]]  # of one camera, each with its time


def recognises(root: Path) -> bool:
    """Whether a folder holds `poses_bounds.npy`."""
    return (root / "poses_bounds.npy").exists()


def read(root: Path) -> Capture:
    """What the file and the images' names say, as one split.

    Times are frames' numbers: in a video, in names, or by order in a camera's folder.

    Raises:
        ValueError: in one line that names the file, for anything missing, malformed or out of range.
    """
    notes = Notes()
    folder = Folder(root, notes)
    path = root / "poses_bounds.npy"
    rows = read_npy(path, MAX_BYTES)
    if rows.ndim != 2 or rows.shape[1] != 17 or not 0 < len(rows) <= MAX_FRAMES:
        raise ValueError(f"{path}: must be an array of cameras x 17, got {rows.shape}")
    if not bool((np.abs(rows) <= MAX_NUMBER).all()):
        raise ValueError(f"{path}: must hold finite numbers up to {MAX_NUMBER:g}, got {np.abs(rows).max():g}")
    images = _images(folder, len(rows))
    total = sum(len(of_camera) for of_camera in images)
    if total > MAX_FRAMES:
        raise ValueError(f"{root}: frames of all cameras must be at most {MAX_FRAMES}, got {total}")
    frames = []
    for index, (row, of_camera) in enumerate(zip(rows, images)):
        where = f"{path}: row {index}"
        values = row[:15].reshape(3, 5)
        matrix = np.stack([values[:, 1], -values[:, 0], values[:, 2], values[:, 3]], axis=1)
        pose = rigid_pose(matrix, where, path.name, Notes())  # rows without 0 0 0 1 are the format's
        height, width = (whole(float(values[i, 4]), f"{where}: size", 1, MAX_SIDE) for i in (0, 1))
        focal = number(float(values[2, 4]), f"{where}: focal length", width / MAX_FOCAL_RATIO, width * MAX_FOCAL_RATIO)
        camera = Intrinsics(width, height, focal, focal)
        for image, time in of_camera:
            name = folder.name(image.path) if image.frame is None else f"{image.path.stem}/{image.frame:05d}"
            frames.append(CaptureFrame(name, pose, camera, image, None, time))
    near, far = float(rows[:, 15].min()), float(rows[:, 16].max())
    if not 0 <= near < far:
        notes.add(f"{path.name}: its near and far are not used, they are {near:g} and {far:g}")
    return Capture(
        path, "llff", {"all": uniquely_named(frames)}, planes=(near, far) if 0 <= near < far else None,
        notes=notes.lines(),
    )  # fmt: skip


def _images(folder: Folder, num_cameras: int) -> list[Images]:
    """The images of each camera: one of each in a folder, or a video, or a folder of images of each camera."""
    seen = []
    for name in IMAGE_FOLDERS:
        paths = folder.listed(folder.root / name, IMAGE_SUFFIXES)
        if len(paths) == num_cameras:
            times = folder.times([path.stem for path in paths])
            return [[(ImageFile(path), time)] for path, time in zip(paths, times)]
        seen += [f"{len(paths)} images in {name}/"] * bool(paths)
    videos = folder.listed(folder.root, VIDEO_SUFFIXES)
    if len(videos) == num_cameras:
        return [[(ImageFile(p, i), float(i)) for i in range(_num_frames(p))] for p in videos]
    folders = [p for p in sorted(folder.root.iterdir()) if p.is_dir() and p.name not in IMAGE_FOLDERS]
    by_camera = [found for p in folders if (found := _of_camera(folder, p))]
    if len(by_camera) == num_cameras:
        return [_numbered(paths) for paths in by_camera]
    seen += [f"{len(videos)} videos"] * bool(videos) + [f"{len(by_camera)} folders of images"] * bool(by_camera)
    raise ValueError(
        f"{folder.root}: poses_bounds.npy has {num_cameras} cameras, so there must be as many images in images/, or "
        f"videos, or folders of images, got {', '.join(seen) or 'none'}; remove what has no pose"
    )


def _of_camera(folder: Folder, path: Path) -> list[Path]:
    """The images of one camera's folder, which may lie in `images/` below it."""
    for place in (path, *(path / name for name in IMAGE_FOLDERS)):
        paths = folder.listed(place, IMAGE_SUFFIXES)
        if paths:
            return paths
    return []


def _numbered(paths: Sequence[Path]) -> Images:
    """Images with the numbers in their names, or where those tell nothing by their order."""
    times = frame_numbers([path.stem for path in paths]) or range(len(paths))
    return [(ImageFile(path), float(time)) for path, time in zip(paths, times)]


def _num_frames(path: Path) -> int:
    found = read_video_header(path).num_frames
    if found > MAX_FRAMES:
        raise ValueError(f"{path}: video must have 1 to {MAX_FRAMES} frames, got {found}; cut it, or export fewer")
    return found
