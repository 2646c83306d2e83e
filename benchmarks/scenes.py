"""Scenes that benchmarks train on: exact ones by name, real ones as folders."""

from pathlib import Path

from dnerf.scenes import SCENES


def scene_overrides(scene: str, resolution: int, data_root: str | None, quick: bool = False) -> list[str]:
    """Overrides of a training run on a scene.

    Args:
        scene: name of an exact scene, or of a folder below `data_root`.
        resolution: width and height of its frames in pixels.
        data_root: folder of real scenes, or None.
        quick: few frames of exact scenes, which are rendered before training begins.

    Raises:
        ValueError: if there is neither.
    """
    if scene in SCENES:
        few = ["data.num_train=12", "data.num_val=1", "data.num_test=2"] if quick else []
        return ["data=synthetic", f"scene={scene}", f"data.resolution={resolution}", *few]
    folder = Path(data_root or "") / scene
    if data_root is None or not folder.is_dir():
        raise ValueError(
            f"scene must be one of {', '.join(sorted(SCENES))} or a folder below data_root (DNERF_DATA), "
            f"got {scene!r} and data_root={data_root!r}"
        )
    return ["data=auto", f"data.root={folder}", f"data.resolution={resolution}"]
