"""A small scene in D-NeRF's format, written by hand rather than by the code under test."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

Scene = Callable[..., Path]


def pose(angle: float = 0.3, distance: float = 4.0) -> list[list[float]]:
    """A rotation about z, and a position."""
    c, s = float(np.cos(angle)), float(np.sin(angle))
    return [[c, -s, 0, 1.5], [s, c, 0, -0.5], [0, 0, 1, distance], [0, 0, 0, 1]]


def random_rgba(index: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 256, (height, width, 4), dtype=np.uint8)


@pytest.fixture
def make_scene(tmp_path: Path) -> Scene:
    """Write a scene: `make_scene(edit)` lets a test spoil the JSON, and images are `random_rgba`."""

    def make(
        edit: Callable[[dict[str, Any]], object] = lambda manifest: None, *, num_frames: int = 3, height: int = 6,
        width: int = 8, split: str = "train", mode: str = "RGBA",
    ) -> Path:  # fmt: skip
        root = tmp_path / "scene"
        (root / split).mkdir(parents=True)
        manifest: dict[str, Any] = {"camera_angle_x": 0.7, "frames": []}
        for i in range(num_frames):
            image = Image.fromarray(random_rgba(i, height, width))
            (image if mode == "RGBA" else image.convert(mode)).save(root / split / f"r_{i}.png")
            frame = {"file_path": f"./{split}/r_{i}", "rotation": 0.1, "time": i / max(num_frames - 1, 1)}
            manifest["frames"].append({**frame, "transform_matrix": pose(i)})
        edit(manifest)
        (root / f"transforms_{split}.json").write_text(json.dumps(manifest))
        return root

    return make
