import json
import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from data_folders import frames_of
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dnerf.core.cameras import Intrinsics, look_at
from dnerf.core.lenses import Distortion
from dnerf.data.formats import read_capture
from dnerf.data.formats.writers import save_blender, save_transforms
from dnerf.data.frames import Frames


def random_frames(num_frames: int = 3, channels: int = 4, seed: int = 0, **changes: object) -> Frames:
    generator = torch.Generator().manual_seed(seed)
    images = torch.randint(0, 256, (num_frames, 6, 8, channels), generator=generator, dtype=torch.uint8)
    if channels == 4:
        images[..., :3] = torch.minimum(images[..., :3], images[..., 3:])
    angles = torch.rand(num_frames, generator=generator).tolist()
    arguments: dict = {
        "images": images,
        "poses": torch.stack([look_at((math.cos(a), math.sin(a), 0.5 + a)) for a in angles]),
        "times": torch.rand(num_frames, generator=generator),
        "intrinsics": Intrinsics.from_angle(8, 6, 0.6911112070083618),
    }
    return Frames(**{**arguments, **changes})


def assert_same(read: Frames, written: Frames) -> None:
    assert torch.equal(read.images, written.images)
    assert torch.equal(read.poses, written.poses)
    assert torch.equal(read.times, written.times)
    assert read.intrinsics == written.intrinsics
    assert (read.near, read.far, read.background) == (written.near, written.far, written.background)


@pytest.mark.parametrize("save", [save_blender, save_transforms])
@given(num_frames=st.integers(1, 3), channels=st.sampled_from([3, 4]), seed=st.integers(0, 2**31))
def test_what_is_written_is_read_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, save: Callable, num_frames: int, channels: int, seed: int
) -> None:
    frames = random_frames(num_frames, channels, seed)
    root = tmp_path_factory.mktemp("written") / "scene"
    save({"train": frames}, root)
    assert_same(frames_of(root, "train"), frames)


@pytest.mark.parametrize("save", [save_blender, save_transforms])
@pytest.mark.parametrize("changes", [
    {"intrinsics": Intrinsics(8, 6, 7.1, 8.3, 3.9, 3.3, "corner"), "near": 0.1, "far": 1e3},
    {"channels": 3, "background": (1.0, 0.5, 0.25)},
])  # fmt: skip
def test_extra_fields_survive_in_every_split(tmp_path: Path, save: Callable, changes: dict[str, Any]) -> None:
    frames, others = random_frames(**changes), random_frames(2, seed=1, **changes)
    save({"train": frames, "test": others}, tmp_path / "scene")
    assert_same(frames_of(tmp_path / "scene", "train"), frames)
    assert_same(frames_of(tmp_path / "scene", "test"), others)


LENS = Distortion("opencv", (0.1, -0.01), (0.001, 0.002))


@pytest.mark.parametrize("lenses", [
    [LENS] * 3,
    [LENS, None, Distortion("opencv", (0.0, 0.02))],
    [Distortion("opencv", (0.1, 0.0, 0.0, 0.05)), None, None],
    [Distortion("fisheye", (0.1,)), Distortion("fisheye", (0.0, 0.02, 0.0, 0.01)), Distortion("fisheye", (0.03,))],
])  # fmt: skip
def test_nerfstudios_format_keeps_cameras_and_lenses_of_their_own(
    tmp_path: Path, lenses: list[Distortion | None]
) -> None:
    cameras = [Intrinsics(8, 6, 9.0 + i, 9.5, 4.0, 3.25, distortion=lens) for i, lens in enumerate(lenses)]
    frames = random_frames(intrinsics=cameras)
    save_transforms({"train": frames}, tmp_path / "scene")
    read = frames_of(tmp_path / "scene", "train")
    for found, camera in zip(read.intrinsics, cameras):
        assert replace(found, distortion=None) == replace(camera, distortion=None)
        coefficients = camera.distortion.coefficients if camera.distortion else (0.0,) * 8
        assert (found.distortion.coefficients if found.distortion else (0.0,) * 8) == coefficients
    assert read_capture(tmp_path / "scene").notes == ()
    with pytest.raises(ValueError, match=r"must share one pinhole in D-NeRF's format, .*; save_transforms writes them"):
        save_blender({"train": frames}, tmp_path / "other")


def test_what_one_transforms_json_cannot_say_is_refused(tmp_path: Path) -> None:
    frames = random_frames()
    fisheye = random_frames(intrinsics=Intrinsics(8, 6, 9.0, 9.0, distortion=Distortion("fisheye", (0.1,))))
    for split, others, message in (
        ("extra", frames, "split must be one of train, val, test"),
        ("test", replace(frames, near=1.0), "near, far, pixel_origin and background must be the same"),
        ("test", fisheye, "must have fisheye lenses only, or none"),
    ):
        with pytest.raises(ValueError, match=message):
            save_transforms({"train": frames, split: others}, tmp_path / "scene")
    with pytest.raises(ValueError, match="must have a train split, got test"):
        save_transforms({"test": frames}, tmp_path / "scene")
    assert not any(tmp_path.iterdir())


def test_other_codebases_find_dnerfs_fields_and_straight_alpha(tmp_path: Path) -> None:
    """As D-NeRF's load_blender.py reads: JSON's own values, file_path + '.png', colour not multiplied by alpha."""
    frames = random_frames()
    save_blender({"train": frames, "val": frames.subset([0]), "test": frames}, tmp_path / "scene")
    meta = json.loads((tmp_path / "scene" / "transforms_train.json").read_text())
    assert meta["camera_angle_x"] == pytest.approx(0.6911112070083618, rel=1e-12)
    assert len(meta["frames"]) == 3
    for i, frame in enumerate(meta["frames"]):
        assert frame["time"] == float(frames.times[i])
        assert np.float32(frame["transform_matrix"]).tolist() == frames.poses[i].tolist()
        straight = np.asarray(Image.open(os.path.join(tmp_path / "scene", frame["file_path"] + ".png"))) / 255.0
        assert straight.shape == (6, 8, 4)
        on_white = straight[..., :3] * straight[..., 3:] + 1 - straight[..., 3:]
        # the straight colour is rounded to 8 bits, which alpha can only make smaller
        assert np.abs(on_white - frames.image(i, torch.ones(3)).numpy()).max() <= 0.5 / 255 + 1e-6
    assert {p.name for p in (tmp_path / "scene").iterdir()} == {
        "train", "val", "test", "transforms_train.json", "transforms_val.json", "transforms_test.json",
    }  # fmt: skip


def test_colours_one_level_above_alpha_are_clamped_and_more_is_refused(tmp_path: Path) -> None:
    frames = random_frames(1)
    frames.images[..., :3] = 101
    frames.images[..., 3] = 100
    save_blender({"train": frames}, tmp_path / "a")
    assert (frames_of(tmp_path / "a", "train").images == 100).all()
    frames.images[0, 2, 3, 1] = 102
    with pytest.raises(ValueError, match=r"frames_by_split\['train'\] must be premultiplied, .* in frame 0"):
        save_blender({"train": frames}, tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_a_folder_that_holds_something_is_left_alone_an_empty_one_filled_and_parents_made(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for root in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(ValueError, match="root must be a new or empty folder"):
            save_blender({"train": random_frames()}, root)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    (tmp_path / "empty").mkdir()
    for root in (tmp_path / "empty", tmp_path / "a" / "b"):
        save_blender({"train": random_frames()}, root)
        assert len(frames_of(root, "train")) == 3
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    save_blender({"train": random_frames()}, tmp_path / "link")
    assert len(frames_of(tmp_path / "elsewhere", "train")) == 3


@pytest.mark.parametrize("splits", [{}, {"../train": None}, {"": None}, {".hidden": None}])
def test_senseless_splits_are_refused(tmp_path: Path, splits: dict[str, None]) -> None:
    with pytest.raises(ValueError, match="split"):
        save_blender({split: random_frames() for split in splits}, tmp_path / "scene")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_an_interrupted_export_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    calls: list[object] = []
    original = Image.Image.save

    def failing(self: Image.Image, *args: Any, **kwargs: Any) -> None:
        calls.append(args)
        if len(calls) > 2:
            raise error
        original(self, *args, **kwargs)

    monkeypatch.setattr(Image.Image, "save", failing)
    with pytest.raises(type(error)):
        save_blender({"train": random_frames(6)}, tmp_path / "scene")
    assert not any(tmp_path.iterdir())
