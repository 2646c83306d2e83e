"""The same scene in the files of every format has the same cameras, rays, times and planes."""

from functools import partial
from pathlib import Path

import data_folders
import numpy as np
import pytest
import torch
from data_folders import FOCAL, HEIGHT, NUM_FRAMES, PLANES, POINTS, WIDTH, WRITERS

from dnerf.core.cameras import Camera
from dnerf.data.capture import Capture, CaptureFrame
from dnerf.data.formats import FORMATS, read_capture

IMAGES = {
    "blender": "train/{:04d}.png", "transforms": "images/{:04d}.png", "nerfies": "rgb/2x/{:06d}.png",
    "llff": "images/{:04d}.png", "colmap": "images/{:04d}.png",
}  # fmt: skip


def frames_of(capture: Capture) -> list[CaptureFrame]:
    return [frame for frames in capture.splits.values() for frame in frames]


def assert_the_scene(frames: list[CaptureFrame]) -> None:
    """Poses, and the rays of all pixels, against directions worked out here pixel by pixel."""
    assert len(frames) == NUM_FRAMES
    for frame, pose in zip(frames, data_folders.poses()):
        # a quaternion's matrix, and rotations in text, are exact to float64's digits
        np.testing.assert_allclose(np.array(frame.pose), pose, atol=1e-12)
        rays = Camera(frame.intrinsics, torch.tensor(frame.pose, dtype=torch.float64)).rays(0.0)
        for pixel in range(WIDTH * HEIGHT):
            column, row = pixel % WIDTH, pixel // WIDTH
            local = np.array([(column + 0.5 - WIDTH / 2) / FOCAL, -(row + 0.5 - HEIGHT / 2) / FOCAL, -1.0])
            direction = pose[:3, :3] @ local / np.linalg.norm(local)
            np.testing.assert_allclose(rays.directions[pixel].numpy(), direction, atol=1e-9)
            np.testing.assert_allclose(rays.origins[pixel].numpy(), pose[:3, 3], atol=1e-9)


@pytest.mark.parametrize(("name", "write"), [
    *((name, write) for name, write in WRITERS.items() if name != "rig"),
    ("colmap", partial(data_folders.write_colmap, binary=False)),
])  # fmt: skip
def test_every_format_gives_the_same_cameras_times_and_images(tmp_path: Path, name: str, write: partial) -> None:
    capture = read_capture(write(tmp_path / "scene"))
    assert capture.format == name
    frames = frames_of(capture)
    assert_the_scene(frames)
    assert [frame.time for frame in frames] == [0, 1, 2, 3]
    paths = [frame.image.path.relative_to(tmp_path / "scene").as_posix() for frame in frames if frame.image]
    assert paths == [IMAGES[name].format(index) for index in range(NUM_FRAMES)]
    assert capture.planes == (None if name == "colmap" else pytest.approx(PLANES, rel=1e-12))
    assert len({id(frame.intrinsics) for frame in frames}) == 1 or name in ("llff", "nerfies")
    if name == "colmap":
        assert capture.points is not None
        np.testing.assert_allclose(capture.points.numpy(), POINTS, rtol=1e-6)


def test_a_rig_has_every_moment_of_every_camera(tmp_path: Path) -> None:
    capture = read_capture(data_folders.write_rig(tmp_path / "scene"))
    assert {split: len(frames) for split, frames in capture.splits.items()} == {"train": 15, "test": 5}
    frames = frames_of(capture)
    assert_the_scene(frames[::5])
    assert [frame.time for frame in frames[5:10]] == [0, 0.5, 1, 1.5, 2]
    assert [frame.image.frame for frame in frames[:5] if frame.image] == [0, 1, 2, 3, 4]
    assert frames[7].name == "train01/00002"
    assert len({frame.pose for frame in frames[5:10]}) == 1
    assert (capture.planes, capture.background, capture.up) == (PLANES, (0, 0.25, 1), (0, 0, 1))


def test_a_folder_of_several_formats_is_read_by_the_first_and_by_any_other_on_request(tmp_path: Path) -> None:
    root = tmp_path / "scene"
    for write in WRITERS.values():
        write(root)
    capture = read_capture(root)
    assert capture.format == "blender"
    others = ["transforms", "nerfies", "llff", "rig", "colmap"]
    assert "data.format=" + " or ".join(others) in capture.notes[0]
    for name in FORMATS:
        assert read_capture(root, name).format == name


def test_the_listing_file_may_be_named_instead_of_its_folder(tmp_path: Path) -> None:
    root = data_folders.write_transforms(tmp_path / "a scene [with] odd, name=#1 '~'")
    assert read_capture(str(root / "transforms.json")) == read_capture(root)


def test_unknown_folders_say_what_was_looked_for_and_where_a_data_set_lies(tmp_path: Path) -> None:
    data_folders.write_llff(tmp_path / "scene")
    for name, said in (("film.mp4", "scripts/capture.py"), ("scene.zip", "unpack it")):
        (tmp_path / name).touch()
        with pytest.raises(ValueError, match=rf"root must be a data set's folder, got the file .*{name}; .*{said}"):
            read_capture(tmp_path / name)
    with pytest.raises(ValueError, match=r"no data set is recognised, none of transforms_train.json .*'scene' below"):
        read_capture(tmp_path)
    with pytest.raises(ValueError, match="images and films alone do not say where cameras stood"):
        read_capture(tmp_path / "scene/images")
    with pytest.raises(ValueError, match="format must be one of auto, blender"):
        read_capture(tmp_path / "scene", "nerf")
    with pytest.raises(ValueError, match=r"transforms_train.json: file does not exist"):
        read_capture(tmp_path / "scene", "blender")
    for root in (tmp_path / "none", "a\0b", "x" * 5000):
        with pytest.raises(ValueError, match="root must be a data set's folder"):
            read_capture(root)


@pytest.mark.parametrize("name", ["nerfies", "llff", "colmap"])
def test_formats_with_fixed_axes_refuse_others(tmp_path: Path, name: str) -> None:
    root = WRITERS[name](tmp_path / "scene")
    with pytest.raises(ValueError, match=f"the format {name} says what a pose's axes are"):
        read_capture(root, axes="opencv")
