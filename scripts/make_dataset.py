"""Export exact frames in D-NeRF's format: python scripts/make_dataset.py scene=walker num_frames=100 out=data/walker"""

from pathlib import Path

from hydra_app import build, run_app
from omegaconf import DictConfig
from tqdm import tqdm

from dnerf.data import SPLITS, SyntheticData, film_by_phone, film_by_rig, save_blender, save_transforms
from dnerf.visualization.video import check_film, write_frames


def main(config: DictConfig) -> None:
    """Render the splits exactly and write the folder; with `film` those of a phone's film, and the film itself."""
    out = Path(config.out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"out: {out} exists and is not an empty folder")
    scene, counts = build(config.scene, trusted=True), {"num_train": config.num_frames, "num_test": config.num_test}
    if config.film is not None:
        check_film(Path(config.film), "mp4")
        frames = film_by_phone(scene, config.resolution, **counts)
        save_transforms(frames, out)
        print("film:", write_frames(frames["train"].images, config.film, "mp4", fps=config.fps))
    elif config.cameras is not None:
        frames = film_by_rig(scene, config.resolution, num_cameras=config.cameras, **counts)
        save_transforms(frames, out)
    else:
        source = SyntheticData(scene, config.resolution, num_val=config.num_val, seed=config.seed, **counts)
        frames = {split: source.frames(split) for split in tqdm(SPLITS, unit="split")}
        save_blender(frames, out)
    print(f"{sum(len(f) for f in frames.values())} frames: {out}")


if __name__ == "__main__":
    run_app(main, "make_dataset")
