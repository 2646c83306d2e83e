"""Say and draw how a data set is understood: python scripts/check_data.py data.root=path/to/scene"""

from pathlib import Path

from hydra_app import build, run_app
from omegaconf import DictConfig

from dnerf.data import FolderData, SceneRecord
from dnerf.data.background_check import data_background
from dnerf.visualization import data_sheet, write_png


def main(config: DictConfig) -> None:
    """Read the data set as training would, print what was found, draw it."""
    data = build(config.data, trusted=True)
    world = data.world()
    frames = data.frames("train")
    scene = data.record()
    if isinstance(data, FolderData):
        print(f"format: {data.capture.format}, {data.capture.path}")
    for split, cameras in scene.cameras.items():
        sizes = sorted({f"{lens.width} x {lens.height}" for lens in cameras.intrinsics})
        shown = sizes[0] if len(sizes) == 1 else f"{len(sizes)} sizes, {sizes[0]} to {sizes[-1]}"
        print(f"{split}: {len(cameras)} {'frames' if cameras.have_images else 'cameras without images'} of {shown}")
    print(f"lens: {_lenses(scene)}")
    print(f"times: {_times(scene)}")
    print(f"background: {data_background(frames)[1]}")
    for note in world.notes:
        print(note)
    for warning in world.warnings:
        print(f"warning: {warning}")
    print(f"drawn: {write_png(data_sheet(scene, frames), Path(config.output))}")


def _lenses(scene: SceneRecord) -> str:
    lenses = {lens for cameras in scene.cameras.values() for lens in cameras.intrinsics}
    first = scene.cameras["train"].intrinsics[0]
    bent = "" if first.distortion is None else f", {first.distortion.model} {first.distortion.radial}"
    others = "" if len(lenses) == 1 else f", one of {len(lenses)}"
    focal = f"focal lengths {first.focal_x:.2f} and {first.focal_y:.2f} pixels"
    center = f"principal point {first.center[0]:.2f}, {first.center[1]:.2f}"
    return f"{focal}, {center}{bent}{others}"


def _times(scene: SceneRecord) -> str:
    first, last = scene.times
    clock = scene.world.clock
    if first == last:
        return "one for all frames: static"
    own = f"{clock.own(first):.10g} to {clock.own(last):.10g} by the data's clock"
    return f"training from {first:.4g} to {last:.4g}, {own}"


if __name__ == "__main__":
    run_app(main, "check_data")
