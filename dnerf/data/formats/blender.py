"""D-NeRF's format: `transforms_{train,val,test}.json` beside image folders.

The format is that of NeRF's Blender scenes (Mildenhall et al. 2020) with a `time` per frame (Pumarola et al. 2021), as
BlenderNeRF and instant-ngp write it, too.
"""

from pathlib import Path

from dnerf.data.capture import SPLITS, Capture, CaptureFrame
from dnerf.data.formats.folder import Folder
from dnerf.data.formats.json_files import Notes
from dnerf.data.formats.manifest import Manifest, merged, named_points


def recognises(root: Path) -> bool:
    """Whether a folder holds `transforms_train.json`."""
    return (root / "transforms_train.json").exists()


def read(root: Path) -> Capture:
    """What the files of all splits say; images of validation and test may be missing.

    Raises:
        ValueError: in one line that names file and field, for anything missing, malformed or out of range.
    """
    notes = Notes()
    folder = Folder(root, notes)
    manifests = {
        split: Manifest(folder, root / f"transforms_{split}.json")
        for split in SPLITS
        if split == "train" or (root / f"transforms_{split}.json").exists()
    }
    splits = {"train": manifests["train"].frames()}
    first = splits["train"][0].intrinsics
    for split, manifest in manifests.items():
        if split != "train":
            splits[split] = manifest.frames(cameras_only=True, size=(first.width, first.height))
    check_clocks(root, splits)
    planes = [found for manifest in manifests.values() if (found := manifest.planes()) is not None]
    return Capture(
        root, "blender", splits,
        planes=(min(near for near, _ in planes), max(far for _, far in planes)) if planes else None,
        background=merged({m.path.name: m.background() for m in manifests.values()}, root, "background"),
        points=named_points(manifests["train"]),
        up=merged({m.path.name: m.up() for m in manifests.values()}, root, "up"),
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
