"""A data set of your own film: python scripts/capture.py video=film.mp4 out_dir=data/mine"""

from pathlib import Path

from hydra_app import run_app
from omegaconf import DictConfig

from dnerf.capturing import StructureSettings, capture, find_films


def main(config: DictConfig) -> None:
    """Choose frames, find the cameras, write the data set, and say how good it is."""
    video, images, model, masks = (
        None if config[name] is None else Path(config[name]) for name in ("video", "images", "model", "masks")
    )
    report = capture(
        Path(config.out_dir), find_films(video, images), StructureSettings(config.lens, config.matching, masks),
        model=model, num_frames=config.num_frames, width=config.width, min_share=config.min_share,
    )  # fmt: skip
    print(*report, f"look at it: python scripts/check_data.py data.root={config.out_dir}", sep="\n")


if __name__ == "__main__":
    run_app(main, "capture")
