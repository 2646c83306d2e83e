"""Camera paths of nerfstudio's viewer are read, undone to the data set's units, and refused in one line."""

import json
import math
from typing import Any

import pytest
import torch

from dnerf.core.cameras import look_at
from dnerf.visualization import read_nerfstudio_path

POSES = torch.stack([look_at((3.0, 1.0, 2.0)), look_at((-1.0, 4.0, 1.0))]).double()


def content(poses: torch.Tensor = POSES, **changes: Any) -> dict[str, Any]:
    frames = [
        {"camera_to_world": pose.flatten().tolist(), "fov": 50.0, "aspect": 1.5, "render_time": 0.25 + 0.5 * i}
        for i, pose in enumerate(poses)
    ]
    return {"camera_type": "perspective", "render_height": 100, "render_width": 150, "camera_path": frames, **changes}


def written(path, value) -> Any:
    path.write_text(json.dumps(value))
    return path


def test_poses_angles_times_and_shape_are_read(tmp_path) -> None:
    path = read_nerfstudio_path(written(tmp_path / "path.json", content()))
    torch.testing.assert_close(path.poses, POSES)
    assert path.times == (0.25, 0.75)
    assert path.aspect == 1.5
    lens = path.intrinsics(60, 40)[0]
    assert lens.focal_y == lens.focal_x == pytest.approx(20 / math.tan(math.radians(25)))  # the angle is vertical
    still = content()
    for frame in still["camera_path"]:
        del frame["render_time"]
    assert read_nerfstudio_path(written(tmp_path / "still.json", still)).times is None


def test_nerfstudio_s_own_normalisation_is_undone(tmp_path) -> None:
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3] = torch.tensor([[0.0, 0, 1, 5], [1, 0, 0, -2], [0, 1, 0, 7]], dtype=torch.float64)
    made = transform @ POSES
    made[:, :3, 3] *= 0.2
    given = {"transform": transform[:3].tolist(), "scale": 0.2}
    path = read_nerfstudio_path(
        written(tmp_path / "path.json", content(made)), written(tmp_path / "dataparser_transforms.json", given)
    )
    torch.testing.assert_close(path.poses, POSES, rtol=0, atol=1e-6)  # of float32 rotations, made exact


def first(change: dict[str, Any]) -> dict[str, Any]:
    value = content()
    value["camera_path"][0].update(change)
    return value


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([], "must hold an object"),
        ({}, "camera_path must be a list"),
        (content(camera_type="fisheye"), "camera_type must be perspective"),
        (first({"camera_to_world": [1.0] * 15}), r"camera_path\[0\].camera_to_world must be 16"),
        (first({"camera_to_world": [2.0 * x for x in POSES[0].flatten().tolist()]}), "not scaled"),
        (first({"fov": 180}), "fov must be in"),
        (first({"fov": None}), "fov must be 1 finite number"),
        (first({"render_time": 1.5}), "render_time must be in"),
        (first({"render_time": None}), "render_time must be 2 finite numbers"),
        (content(render_height=0), "must be positive"),
        (content(render_width="wide"), "render_width must be"),
    ],
)
def test_what_is_no_path_is_refused_in_one_line(tmp_path, value, message) -> None:
    with pytest.raises(ValueError, match=message) as error:
        read_nerfstudio_path(written(tmp_path / "path.json", value))
    assert "path.json" in str(error.value)


@pytest.mark.parametrize("scale", [1e-320, 1e-308])
def test_a_scale_that_moves_cameras_out_of_all_numbers_is_refused(tmp_path, scale) -> None:
    """Found by fuzzing: an error of the singular value decomposition."""
    given = written(tmp_path / "transforms.json", {"transform": torch.eye(4)[:3].tolist(), "scale": scale})
    with pytest.raises(ValueError, match=r"transforms\.json: cameras must be at finite places; correct scale"):
        read_nerfstudio_path(written(tmp_path / "path.json", content()), given)
