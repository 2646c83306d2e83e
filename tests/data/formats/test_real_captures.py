"""Captures of others that hold their cameras twice, in two formats: both are read as the same."""

import os
from pathlib import Path

import numpy as np
import pytest

from dnerf.data.formats import read_capture


def capture(name: str) -> Path:
    if "DNERF_CAPTURES" not in os.environ:
        pytest.skip("DNERF_CAPTURES is not set")
    return Path(os.environ["DNERF_CAPTURES"]) / name


@pytest.mark.real_data
def test_nerfies_cameras_are_those_of_colmap() -> None:
    nerfies, colmap = read_capture(capture("cake")), read_capture(capture("cake"), "colmap")
    assert {split: len(frames) for split, frames in nerfies.splits.items()} == {"train": 82, "test": 5}
    registered = {frame.name: frame for frame in colmap.splits["all"]}
    for frames in nerfies.splits.values():
        for frame in frames:
            other = registered[frame.name]
            # float32 in the camera files
            np.testing.assert_allclose(np.array(frame.pose), np.array(other.pose), atol=5e-7)
            assert frame.time == other.time == float(frame.name)
            assert frame.intrinsics.focal_x == pytest.approx(4 * other.intrinsics.focal_x, rel=1e-5)
    assert nerfies.planes == pytest.approx((0.069967, 21.12255), rel=1e-5)


@pytest.mark.real_data
def test_llffs_cameras_are_those_of_an_exporter() -> None:
    exported, llff = read_capture(capture("balloon1")), read_capture(capture("balloon1"), "llff")
    for frame, other in zip(exported.splits["train"], llff.splits["all"]):
        np.testing.assert_allclose(np.array(frame.pose), np.array(other.pose), atol=1e-9)
        assert frame.image == other.image
        assert other.time is not None
        assert frame.time == pytest.approx(0.005 * other.time)
    assert exported.splits["train"][0].intrinsics.distortion is not None
    assert exported.points is None  # the file beside them holds random points, and nothing names it


@pytest.mark.real_data
def test_smoke_is_five_films_of_four_seconds() -> None:
    smoke = read_capture(capture("smoke"))
    assert {split: len(frames) for split, frames in smoke.splits.items()} == {"train": 480, "test": 120}
    assert {(frame.intrinsics.width, frame.intrinsics.height) for frame in smoke.splits["test"]} == {(1080, 1920)}
    times = [frame.time for frame in smoke.splits["test"]]
    assert times == pytest.approx(np.arange(120) / 30)
    assert (smoke.planes, smoke.background, smoke.up) == ((1.1, 1.5), (0, 0, 0), (0, 1, 0))
