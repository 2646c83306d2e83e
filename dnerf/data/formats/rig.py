"""Fixed cameras with a video each and `info.json`: ScalarFlow's smoke (Eckert et al. 2019) as HyFluid packs it."""

from pathlib import Path
from typing import Any

from dnerf.data.capture import Capture, CaptureFrame, ImageFile
from dnerf.data.formats import json_files as files
from dnerf.data.formats.folder import Folder
from dnerf.data.formats.keys import LENS_KEYS
from dnerf.data.formats.manifest import color, stated_planes, uniquely_named
from dnerf.data.formats.manifest_cameras import MAX_SIDE, LensFields
from dnerf.data.formats.poses import rigid_pose
from dnerf.data.videos import read_video_header

SPLITS = {"train": "train_videos", "test": "test_videos"}
KNOWN = LENS_KEYS | {
    *SPLITS.values(), "file_name", "frame_rate", "frame_num", "camera_hw", "transform_matrix", "frame_bkg_color",
    "near", "far", "voxel_scale", "voxel_matrix", "render_center", "phi", "rot", "pixel_origin",
}  # fmt: skip
UP = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


def recognises(root: Path) -> bool:
    """Whether a folder holds `info.json` that lists videos."""
    try:
        return "train_videos" in files.read_object(root / "info.json")
    except ValueError:
        return False


def read(root: Path) -> Capture:
    """What the file says; each video's frames, with times in seconds.

    Raises:
        ValueError: in one line that names file and field, for anything missing, malformed or out of range.
    """
    notes = files.Notes()
    folder, path = Folder(root, notes), root / "info.json"
    fields = files.read_object(path)
    splits: dict[str, tuple[CaptureFrame, ...]] = {}
    left = files.MAX_FRAMES
    for split, key in SPLITS.items():
        videos = fields.get(key) if split != "train" else files.required(fields, key, str(path))
        if videos is not None and not isinstance(videos, list):
            raise ValueError(f"{path}: {key} must be a list of videos, got {files.short(videos)}")
        frames: list[CaptureFrame] = []
        for index, video in enumerate(videos or ()):
            if not isinstance(video, dict):
                raise ValueError(f"{path}: {key}[{index}] must be an object, got {files.short(video)}")
            frames += _frames(folder, video, fields, f"{path}: {key}[{index}]", left - len(frames))
        left -= len(frames)
        if frames:
            splits[split] = uniquely_named(frames)
    if "train" not in splits:
        raise ValueError(f"{path}: train_videos must name at least one video, got none")
    _note_unknown(fields, notes)
    return Capture(
        path, "rig", splits, planes=stated_planes(fields, path),
        background=color(fields.get("frame_bkg_color"), f"{path}: frame_bkg_color"),
        up=UP.get(fields["rot"]) if isinstance(fields.get("rot"), str) else None, notes=notes.lines(),
    )  # fmt: skip


def _frames(folder: Folder, video: dict[str, Any], shared: dict[str, Any], where: str, most: int) -> list[CaptureFrame]:
    """The frames of one video, at most so many."""
    _note_unknown(video, folder.notes)
    name = files.text(files.required(video, "file_name", where), f"{where}.file_name")
    path = folder.inside(folder.root / name, f"{where}.file_name")
    if not path.is_file():
        raise ValueError(f"{where}.file_name: no video {path}; put it there, or remove it from the list")
    stated = [video.get(key) for key in ("frame_num", "frame_rate", "camera_hw")]
    if None in stated:
        header = read_video_header(path)
        stated = [
            found if value is None else value
            for value, found in zip(stated, (header.num_frames, header.fps, [header.height, header.width]))
        ]
    count = files.whole(stated[0], f"{where}.frame_num", 1, files.MAX_FRAMES)
    rate = files.number(stated[1], f"{where}.frame_rate", 1e-3, 1e6)
    height, width = (int(x) for x in files.numbers(stated[2], f"{where}.camera_hw", 2, 1, MAX_SIDE))
    if count > most:
        raise ValueError(
            f"{where}.frame_num: frames of all videos must be at most {files.MAX_FRAMES}, got more; cut the videos"
        )
    values = files.matrix(
        files.required(video, "transform_matrix", where), f"{where}.transform_matrix", ((4, 4), (3, 4))
    )
    pose = rigid_pose(values, f"{where}.transform_matrix", "info.json", folder.notes)
    lens = LensFields(video, shared, where, str(folder.root / "info.json"))
    intrinsics = lens.intrinsics(*(lens.stated_size() or (width, height)))
    stem = path.name.removesuffix(path.suffix)
    return [
        CaptureFrame(f"{stem}/{index:05d}", pose, intrinsics, ImageFile(path, index), None, index / rate)
        for index in range(count)
    ]


def _note_unknown(fields: dict[str, Any], notes: files.Notes) -> None:
    for key in sorted(fields.keys() - KNOWN):
        notes.add(f"info.json: key {files.short(key)} is not known, it was ignored")
