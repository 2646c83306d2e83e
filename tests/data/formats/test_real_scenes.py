"""D-NeRF's own scenes, as published."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from data_folders import frames_of
from PIL import Image


def real_scene(name: str) -> Path:
    if "DNERF_DATA" not in os.environ:
        pytest.skip("DNERF_DATA is not set")
    return Path(os.environ["DNERF_DATA"]) / name


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "counts"), [("jumpingjacks", (200, 20, 20)), ("mutant", (150, 20, 20)), ("lego", (50, 11, 20))]
)
def test_real_scenes_have_the_published_facts(name: str, counts: tuple[int, int, int]) -> None:
    root = real_scene(name)
    for split, count in zip(("train", "val", "test"), counts):
        frames = frames_of(root, split, 40)
        assert len(frames) == count
        assert frames.has_alpha
        assert frames.images.shape[1:] == (40, 40, 4)
        assert (float(frames.times.min()), float(frames.times.max())) == (0, 1)
        assert (frames.times.diff() > 0).all()
        # 0.5 width / tan(0.5 * 0.6911112), known from NeRF's scenes as 1111.11 at 800
        assert frames.intrinsics[0].focal_x * 20 == pytest.approx(1111.111, abs=1e-3)
        rays = frames.camera(0).rays(0.0)  # D-NeRF's planes, which the files do not state
        # z-depths 2 and 6 are longer along slanted rays: the corner pixel's by 1 / cos
        corner = math.sqrt(1 + 2 * (19.5 / frames.intrinsics[0].focal_x) ** 2)
        assert float(rays.near[0]) == pytest.approx(2 * corner, rel=1e-6)
        assert float(rays.far[0]) == pytest.approx(6 * corner, rel=1e-6)
        # the cameras stand about 4 away and look at the scene near the origin
        to_origin = -frames.poses[:, :3, 3] / frames.poses[:, :3, 3].norm(dim=-1, keepdim=True)
        assert float((to_origin * -frames.poses[:, :3, 2]).sum(-1).min()) > 0.9


@pytest.mark.real_data
def test_a_real_image_on_white_is_the_area_average_of_the_whole_one() -> None:
    root = real_scene("mutant")
    frames = frames_of(root, "val", 400)
    assert frames.images.numel() == 20 * 400 * 400 * 4
    straight = np.asarray(Image.open(root / "val" / "r_007.png")).astype(float) / 255
    on_white = straight[..., :3] * straight[..., 3:] + 1 - straight[..., 3:]
    averaged = on_white.reshape(400, 2, 400, 2, 3).mean((1, 3))
    # two roundings to 8 bits, of colour and of alpha
    assert np.abs(frames.image(7, torch.ones(3)).numpy() - averaged).max() <= 1 / 255 + 1e-6
    assert float(frames.image(7, torch.ones(3)).mean()) == pytest.approx(averaged.mean(), abs=1e-4)
    assert 0.8 < averaged.mean() < 0.99
