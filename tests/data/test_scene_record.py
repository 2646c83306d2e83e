"""A run's record of its data set comes back as it was, and what is none is refused in one line."""

import json
from dataclasses import replace

import pytest
import torch

from dnerf.core.cameras import Intrinsics
from dnerf.core.lenses import Distortion
from dnerf.data.normalization import Clock, Similarity, upright
from dnerf.data.scene_record import SCENE, CameraSet, SceneRecord, World
from dnerf.data.synthetic import random_views

LENS = Intrinsics(40, 30, 55.0, 54.0, center_x=19.5, pixel_origin="corner", distortion=Distortion(radial=(0.1, -0.01)))
WORLD = World(
    ((-1.25, -1.0, -0.5), (1.25, 1.0, 0.5)), Similarity(0.3, upright((0.1, 0.9, 0.2)), (1.0, 2e6, 3.0)),
    Clock(10.0, 3.0), (0.7, None), True, ("a note",), ("a warning",),
)  # fmt: skip


def record() -> SceneRecord:
    poses, times = random_views(5)
    other = replace(LENS, width=20, distortion=None)
    train = CameraSet(poses, 0.2 + 0.5 * times, (LENS, other, LENS, LENS, other), tuple("abcde"))
    return SceneRecord(WORLD, {"train": train, "test": CameraSet(poses[:2], times[:2], (LENS, LENS), (), False)})


def test_a_record_comes_back_bit_for_bit(tmp_path) -> None:
    record().write(tmp_path)
    back = SceneRecord.read(tmp_path)
    assert back.world == WORLD
    for split, cameras in record().cameras.items():
        assert torch.equal(back.cameras[split].poses, cameras.poses)
        assert torch.equal(back.cameras[split].times, cameras.times)
        assert (back.cameras[split].intrinsics, back.cameras[split].names) == (cameras.intrinsics, cameras.names)
        assert back.cameras[split].have_images == cameras.have_images
    lenses = back.cameras["train"].intrinsics
    assert lenses[0] is lenses[2]
    assert back.times == pytest.approx((0.2, 0.7))
    assert back.split(None)[0] == "test"
    with pytest.raises(ValueError, match="split must be one of train, test, got 'val'"):
        back.split("val")


@pytest.mark.parametrize(("change", "message"), [
    (lambda value: value.update(version=99), "version must be 1"),
    (lambda value: value.pop("world"), "world"),
    (lambda value: value["cameras"].pop("train"), "train split"),
    (lambda value: value["world"].update(box=[[0, 0, 0], [0, 0, 0]]), "low < high"),
    (lambda value: value["world"]["similarity"].update(scale=-1), "scale must be positive"),
    (lambda value: value["world"]["similarity"].update(scale="1"), "scale must be finite numbers"),
    (lambda value: value["world"]["clock"].update(length=0), "length positive"),
    (lambda value: value["world"].update(planes=[1]), "planes|values"),
    (lambda value: value["cameras"]["train"].update(times=[0.0] * 4), "times must have shape"),
    (lambda value: value["cameras"]["train"].update(times=[2.0] * 5), r"times must be in \[0, 1\]"),
    (lambda value: value["cameras"]["train"].update(intrinsics_indices=[9] * 5), "must name intrinsics"),
    (lambda value: value["cameras"]["train"]["intrinsics"][0].update(width=1.5), "width must be a whole"),
    (lambda value: value["cameras"]["train"]["intrinsics"][0].update(other=1), "other"),
    (lambda value: value["cameras"]["train"]["poses"][0].reverse(), "rigid"),
])  # fmt: skip
def test_a_changed_record_is_refused_in_one_line(tmp_path, change, message) -> None:
    record().write(tmp_path)
    value = json.loads((tmp_path / SCENE).read_text())
    change(value)
    (tmp_path / SCENE).write_text(json.dumps(value))
    with pytest.raises(ValueError, match=message) as error:
        SceneRecord.read(tmp_path)
    assert SCENE in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", ["", "[]", "{", "[" * 100_000, "null", '{"version": 1, "world": 3, "cameras": []}'])
def test_what_is_no_record_is_refused(tmp_path, content) -> None:
    (tmp_path / SCENE).write_text(content)
    with pytest.raises(ValueError, match=SCENE):
        SceneRecord.read(tmp_path)
    (tmp_path / SCENE).unlink()
    with pytest.raises(ValueError, match="file does not exist"):
        SceneRecord.read(tmp_path)
