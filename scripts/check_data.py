"""Say and draw how a data set is understood: python scripts/check_data.py data.root=path/to/scene"""

from pathlib import Path

from hydra_app import build, run_app
from omegaconf import DictConfig

from dnerf.data import FolderData
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
    for line in scene.summary():
        print(line)
    print(f"background: {data_background(frames)[1]}")
    for note in world.notes:
        print(note)
    for warning in world.warnings:
        print(f"warning: {warning}")
    print(f"drawn: {write_png(data_sheet(scene, frames), Path(config.output))}")


if __name__ == "__main__":
    run_app(main, "check_data")
