import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import data_folders
import imageio.v2 as imageio
import numpy as np
import pytest

from dnerf.data.formats import read_capture


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return data_folders.write_rig(tmp_path / "scene")


def edited(root: Path, edit: Callable[[dict[str, Any]], object]) -> Path:
    fields = json.loads((root / "info.json").read_text())
    edit(fields)
    (root / "info.json").write_text(json.dumps(fields))
    return root


def video(**changes: Any) -> Callable[[dict[str, Any]], object]:
    return lambda fields: fields["train_videos"][1].update(changes)


def test_axes_may_be_opencvs_and_lenses_are_those_of_manifests(root: Path) -> None:
    def edit(fields: dict[str, Any]) -> None:
        for one in fields["train_videos"] + fields["test_videos"]:
            one["transform_matrix"] = (np.array(one["transform_matrix"]) @ data_folders.FLIP).tolist()
        fields["train_videos"][0].update(fl_x=9.0, cx=3.5, cy=2.5, k1=0.1)

    frames = read_capture(edited(root, edit), axes="opencv").splits["train"]
    np.testing.assert_allclose(np.array(frames[0].pose), data_folders.poses()[0], atol=1e-12)
    camera = frames[0].intrinsics
    assert (camera.focal_x, camera.center_x, camera.width, camera.height) == (9, 3.5, 8, 6)
    assert camera.distortion is not None
    with pytest.raises(ValueError, match=r"look away .*data.axes=opencv"):
        read_capture(root)


@pytest.mark.parametrize(("edit", "message"), [
    (lambda f: f.update(train_videos=[]), "train_videos must name at least one video"),
    (lambda f: f.update(train_videos="x"), "train_videos must be a list of videos, got 'x'"),
    (lambda f: f.update(test_videos=[3]), r"test_videos\[0\] must be an object, got 3"),
    (lambda f: f.update(near=2, far=1), "near must be less than far, got 2 and 1"),
    (lambda f: f.update(frame_bkg_color=[0, 0]), "frame_bkg_color must be a list of 3 numbers"),
    (video(file_name="none.mp4"), r"train_videos\[1\].file_name: no video .*none.mp4; put it there"),
    (video(file_name="../train01.mp4"), "must stay inside the data set's folder"),
    (video(file_name="/etc/passwd"), "must stay inside the data set's folder"),
    (video(frame_num=0), r"train_videos\[1\].frame_num must be a number in \[1, 10000\], got 0"),
    (video(frame_num=10_000), "frames of all videos must be at most 10000, got more"),
    (video(frame_num=10**9), "frame_num must be a number"),
    (video(frame_rate=0), "frame_rate must be a number"),
    (video(camera_hw=[6]), "camera_hw must be a list of 2 numbers"),
    (video(transform_matrix=None), r"train_videos\[1\].transform_matrix is missing"),
    (video(camera_angle_x=None), "camera_angle_x, fl_x or K must be given"),
])  # fmt: skip
def test_bad_fields_are_named_in_one_line(root: Path, edit: Callable, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        read_capture(edited(root, edit))
    assert "\n" not in str(caught.value)


def test_unknown_keys_get_a_note(root: Path) -> None:
    notes = read_capture(edited(root, lambda f: f.update(weather="calm"))).notes
    assert notes == ("info.json: key 'weather' is not known, it was ignored",)


def test_what_the_file_does_not_say_of_a_video_is_taken_from_it(root: Path) -> None:
    with imageio.get_writer(root / "train01.mp4", fps=25) as writer:
        for _ in range(3):
            writer.append_data(np.zeros((16, 32, 3), np.uint8))
    changes = {"frame_num": None, "frame_rate": None, "camera_hw": None}
    frames = read_capture(edited(root, video(**changes))).splits["train"][5:8]
    assert [frame.time for frame in frames] == pytest.approx([0, 0.04, 0.08])
    assert {(frame.intrinsics.width, frame.intrinsics.height) for frame in frames} == {(32, 16)}


def test_a_video_named_twice_has_frames_of_two_names(root: Path) -> None:
    frames = read_capture(edited(root, video(file_name="train00.mp4"))).splits["train"]
    assert len({frame.name for frame in frames}) == 15
