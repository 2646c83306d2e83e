"""D-NeRF's format: `transforms_{train,val,test}.json` beside image folders.

The format is that of NeRF's Blender scenes (Mildenhall et al. 2020) with a `time` per frame (Pumarola et al. 2021), as
BlenderNeRF and instant-ngp write it, too.
"""

from pathlib import Path

from dnerf.data.capture import Capture, CaptureFrame
from dnerf.data.formats.folder import Folder
from dnerf.data.formats.json_files import Notes
from dnerf.data.formats.manifest import Manifest, merged, named_points

SPLITS = ("train", "val", "test")


def recognises(root: Path) -> bool:
    """Whether a folder holds `transforms_train.json`."""
    return (root / "transforms_train.json").exists()


def read(root: Path, *, opencv: bool = False) -> Capture:
    """What the files of all splits say; images of validation and test may be missing.

    Args:
        opencv: whether the files' matrices have the axes x right, y down, z forward.

    Raises:
        ValueError: in one line that names file and field, for anything missing, malformed or out of range.
    """
    notes = Notes()
    folder = Folder(root, notes)
    manifests = {
        split: Manifest(folder, root / f"transforms_{split}.json", opencv=opencv)
        for split in SPLITS
        if split == "train" or (root / f"transforms_{split}.json").exists()
    }
    splits: dict[str, tuple[CaptureFrame, ...]] = {}
    for split, manifest in manifests.items():
        first = splits["train"][0].intrinsics if splits else None
        size = None if first is None else (first.width, first.height)
        splits[split] = manifest.frames(cameras_only=split != "train", size=size)
    check_clocks(root, splits)
    planes = [found for manifest in manifests.values() if (found := manifest.planes()) is not None]
    said = {manifest.path.name: manifest for manifest in manifests.values()}
    return Capture(
        root, "blender", splits,
        planes=(min(near for near, _ in planes), max(far for _, far in planes)) if planes else None,
        background=merged({name: manifest.background() for name, manifest in said.items()}, root, "background"),
        points=named_points(manifests["train"]),
        up=merged({name: manifest.up() for name, manifest in said.items()}, root, "up"),
        notes=notes.lines(),
    )  # fmt: skip


def check_clocks(root: Path, splits: dict[str, tuple[CaptureFrame, ...]]) -> None:
    """Raise unless all splits have times, or none has."""
    timed = {split: frames[0].time is not None for split, frames in splits.items() if frames}
    if len(set(timed.values())) > 1:
        without = ", ".join(split for split, has_times in timed.items() if not has_times)
        raise ValueError(
            f"{root}: frames of all splits must have a time, or none; {without} has none; add or remove them"
        )
