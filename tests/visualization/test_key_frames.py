import json
import math
from pathlib import Path

import pytest
import torch

from dnerf.core.cameras import look_at
from dnerf.data.normalization import Similarity, upright
from dnerf.visualization import parse_key_frames, read_key_frames

EXAMPLE = Path(__file__).parents[2] / "examples" / "keyframes.json"


def keys(*entries: dict, **others: object) -> dict:
    return {"keyframes": list(entries), **others}


def test_example_file_reads_and_hits_its_keys() -> None:
    frames = read_key_frames(EXAMPLE)
    poses, times, angles = frames.sample(30)
    assert len(poses) == len(times) == len(angles) == 5 * 30 + 1
    content = json.loads(EXAMPLE.read_text())["keyframes"]
    for key in content:
        index = round(30 * key["seconds"])
        assert times[index] == pytest.approx(key["time"], abs=1e-12)
    a, e = math.radians(120), math.radians(30)
    eye = [4 * math.cos(e) * math.cos(a), 4 * math.cos(e) * math.sin(a), 4 * math.sin(e)]
    torch.testing.assert_close(poses[60], look_at(eye))
    assert angles[90] == pytest.approx(math.radians(40))
    # time stands still between the two keys that say so
    assert times[60:91] == pytest.approx([0.5] * 31)


def test_what_a_key_leaves_out_runs_on() -> None:
    frames = parse_key_frames(
        keys(
            {"seconds": 0, "eye": [4, 0, 1], "time": 0},
            {"seconds": 1, "target": [0, 0, 0.5]},
            {"seconds": 2, "eye": [4, 2, 1], "time": 1},
            interpolation="linear",
        )
    )
    poses, times, angles = frames.sample(1)
    assert times == [0, 0.5, 1]
    torch.testing.assert_close(poses[1], look_at((4.0, 1.0, 1.0), (0, 0, 0.5)))
    assert angles == [None] * 3


def test_defaults_place_a_camera_and_azimuths_make_whole_turns() -> None:
    poses, times, _ = parse_key_frames(keys({"seconds": 3})).sample(30)
    elevation = math.radians(25)
    torch.testing.assert_close(poses, look_at((4 * math.cos(elevation), 0, 4 * math.sin(elevation)))[None])
    assert times == [0]
    frames = parse_key_frames(keys({"seconds": 0, "azimuth": 0}, {"seconds": 4, "azimuth": 360}))
    poses, _, _ = frames.sample(1)
    torch.testing.assert_close(poses[0], poses[4], rtol=0, atol=1e-6)
    assert poses[2, 0, 3] < -3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], 'a list "keyframes"'),
        ({"keyframes": []}, 'a list "keyframes"'),
        (keys({"seconds": 0}, fps=3), "got 'fps'"),
        (keys({"seconds": 0}, interpolation="cubic"), "interpolation must be one of smooth, linear"),
        (keys({"time": 0}), r"keyframes\[0\] must have seconds"),
        (keys(3), r"keyframes\[0\] must be an object, got int"),
        (keys({"seconds": 0, "fov": 3}), r"keyframes\[0\] must have only .*; got 'fov'"),
        (keys({"seconds": 1}, {"seconds": 1}), r"keyframes\[1\].seconds must be more than 1.0, got 1.0"),
        (keys({"seconds": 0, "time": 1.5}), r"keyframes\[0\].time must be in \[0, 1\], got 1.5"),
        (keys({"seconds": 0, "time": True}), r"keyframes\[0\].time must be a finite number, got True"),
        (keys({"seconds": 0, "time": math.nan}), r"keyframes\[0\].time must be a finite number, got nan"),
        (keys({"seconds": 10**400}), r"keyframes\[0\].seconds must be a finite number"),
        (keys({"seconds": 0, "eye": [1, 2]}), r"keyframes\[0\].eye must be 3 finite numbers, got \[1, 2\]"),
        (keys({"seconds": 0, "azimuth": [1]}), r"keyframes\[0\].azimuth must be a finite number, got \[1\]"),
        (keys({"seconds": 0, "radius": 0}), r"keyframes\[0\].radius must be > 0"),
        (keys({"seconds": 0, "elevation": 90}), r"keyframes\[0\].elevation must be in \(-90, 90\)"),
        (keys({"seconds": 0, "field_of_view": 180}), r"keyframes\[0\].field_of_view must be in \(0, 180\)"),
        (keys({"seconds": 0, "eye": [4, 0, 0]}, {"seconds": 1, "radius": 3}), "by eye or by .*, got eye and radius"),
    ],
)
def test_wrong_entries_are_named(content: object, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        parse_key_frames(content)
    if "nan" not in str(content):
        path = tmp_path / "keys.json"
        path.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=f"{path}: .*{message}"):
            read_key_frames(path)


@pytest.mark.parametrize("text", [None, "{", "[" * 100000, '"\\ud800"'])
def test_unreadable_files_are_named(text: str | None, tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=str(path)):
        read_key_frames(path)


def test_absurdly_long_films_and_an_eye_at_its_target_are_refused() -> None:
    frames = parse_key_frames(keys({"seconds": 0}, {"seconds": 1e9}))
    with pytest.raises(ValueError, match="keyframes last 30000000001 frames"):
        frames.sample(30)
    frames = parse_key_frames(keys({"seconds": 0, "eye": [-2, 0, 0]}, {"seconds": 2, "eye": [2, 0, 0]}))
    with pytest.raises(ValueError, match="keyframes at 1 seconds: eye must differ from target"):
        frames.sample(4)


def test_key_frames_in_a_data_set_s_units_show_the_same_from_the_world() -> None:
    there = Similarity(0.25, upright((0, 1, 0)), (4.0, -2.0, 1.0))
    keys = [{"seconds": 0, "eye": [8, 1, 2], "target": [4, -2, 1]}, {"seconds": 1, "eye": [0, 3, 5]}]
    frames = parse_key_frames({"keyframes": keys})
    poses = frames.in_world(there).sample(4)[0].double()
    eyes = there.positions_from_world(poses[:, :3, 3])
    torch.testing.assert_close(eyes, frames.sample(4)[0][:, :3, 3].double(), rtol=0, atol=1e-5)
    around = parse_key_frames({"keyframes": [{"seconds": 0, "radius": 8}]}).in_world(there)
    pose = around.sample(1, {"target": (0.0, 0.0, 1.0), "elevation": (0.0,)})[0][0]
    torch.testing.assert_close(pose[:3, 3], torch.tensor([2.0, 0.0, 1.0]))
