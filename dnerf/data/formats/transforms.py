"""A single `transforms.json`, as nerfstudio, instant-ngp, BlenderNeRF and many capture apps write it."""

from pathlib import Path

from dnerf.data.capture import SPLITS, Capture, CaptureFrame
from dnerf.data.formats.folder import Folder
from dnerf.data.formats.json_files import Notes, short
from dnerf.data.formats.manifest import Manifest, named_points


def recognises(root: Path) -> bool:
    """Whether a folder holds `transforms.json`."""
    return (root / "transforms.json").exists()


def read(root: Path) -> Capture:
    """What the file says; its frames are one split, unless it lists file names of several as nerfstudio does.

    Raises:
        ValueError: in one line that names file and field, for anything missing, malformed or out of range.
    """
    notes = Notes()
    manifest = Manifest(Folder(root, notes), root / "transforms.json")
    frames = manifest.frames()
    return Capture(
        manifest.path, "transforms", _by_split(manifest, frames, notes), planes=manifest.planes(),
        background=manifest.background(), points=named_points(manifest), up=manifest.up(), notes=notes.lines(),
    )  # fmt: skip


def _by_split(
    manifest: Manifest, frames: tuple[CaptureFrame, ...], notes: Notes
) -> dict[str, tuple[CaptureFrame, ...]]:
    """Frames by `train_filenames`, `val_filenames` and `test_filenames`, where the file has them."""
    splits = {}
    by_name: dict[str, list[CaptureFrame]] = {}
    for fields, frame in zip(manifest.listed, frames):
        by_name.setdefault(str(fields["file_path"]), []).append(frame)
    for split in SPLITS:
        key = f"{split}_filenames"
        names = manifest.fields.get(key)
        if not names:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) and name in by_name for name in names):
            raise ValueError(f"{manifest.path}: {key} must list file_path of frames, got {short(names)}")
        splits[split] = tuple(frame for name in dict.fromkeys(names) for frame in by_name[name])
    if "train" not in splits:
        return {"all": frames}
    left = len(frames) - len({id(frame) for named in splits.values() for frame in named})
    if left:
        notes.add(f"{manifest.path.name}: {left} frames are in none of its lists of file names, they are not used")
    return splits
