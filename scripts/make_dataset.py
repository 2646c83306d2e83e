"""Export exact frames in D-NeRF's format: python scripts/make_dataset.py scene=walker num_frames=100 out=data/walker"""

from pathlib import Path

from hydra_app import build, run_app
from omegaconf import DictConfig
from tqdm import tqdm

from dnerf.data import SPLITS, SyntheticData, save_blender


def main(config: DictConfig) -> None:
    """Render the splits exactly and write the folder."""
    out = Path(config.out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"out: {out} exists and is not an empty folder")
    source = SyntheticData(
        build(config.scene, trusted=True),
        config.resolution,
        num_train=config.num_frames,
        num_val=config.num_val,
        num_test=config.num_test,
        seed=config.seed,
    )
    frames = {split: source.frames(split) for split in tqdm(SPLITS, unit="split")}
    save_blender(frames, out)
    print(f"{sum(len(f) for f in frames.values())} frames: {out}")


if __name__ == "__main__":
    run_app(main, "make_dataset")
