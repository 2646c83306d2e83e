"""Poses in another convention are recognised by what cameras look at."""

import json
import math
from pathlib import Path

import data_folders
import numpy as np
import pytest
import torch
from data_folders import FLIP
from hypothesis import given
from hypothesis import strategies as st

from dnerf.data.formats import read_capture
from dnerf.data.formats.axes import common_focus, looks_away, looks_inverted


def ring(count: int, *, outwards: bool = False, spread: float = math.tau, radius: float = 4.0) -> np.ndarray:
    """Cameras on an arc that look at a point, or away from it."""
    poses = []
    for angle in np.linspace(0, spread, count, endpoint=False):
        back = np.array([math.cos(angle), math.sin(angle), 0.5])
        back /= np.linalg.norm(back)
        position = np.array([5.0, -3.0, 100.0]) + radius * back
        back = -back if outwards else back
        right = np.cross([0.0, 0, 1], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
        poses.append(pose)
    return np.array(poses)


@given(count=st.integers(3, 20), spread=st.floats(1.0, math.tau), radius=st.floats(1e-3, 1e3))
def test_cameras_around_something_look_at_it_and_with_opencvs_axes_away(
    count: int, spread: float, radius: float
) -> None:
    poses = ring(count, spread=spread, radius=radius)
    assert not looks_away(poses)
    assert looks_away(poses @ FLIP)


@given(st.integers(0, 2**31))
def test_the_common_focus_is_where_all_axes_meet(seed: int) -> None:
    generator = np.random.default_rng(seed)
    point, centers = generator.normal(size=3), generator.normal(size=(6, 3)) * 10
    forward = (point - centers) / np.linalg.norm(point - centers, axis=1, keepdims=True)
    focus = common_focus(centers, forward)
    if focus is not None:  # six directions may happen to be nearly parallel
        np.testing.assert_allclose(focus, point, atol=1e-9)


def test_what_cannot_be_judged_is_not() -> None:
    still = np.repeat(ring(3)[:1], 20, 0)
    parallel = still.copy()
    parallel[:, 0, 3] += np.linspace(-1, 1, 20)
    for poses in (still, parallel, ring(1), ring(2, spread=0.01)):
        assert common_focus(poses[:, :3, 3], -poses[:, :3, 2]) is None
        assert not looks_away(poses)
        assert not looks_away(poses @ FLIP)


def test_a_walk_that_looks_around_has_no_common_focus() -> None:
    generator = np.random.default_rng(0)
    poses = ring(200, outwards=True)
    poses[:, :3, 3] = generator.uniform(-5, 5, (200, 3))
    assert not looks_away(poses)


@given(st.integers(0, 2**31), st.booleans())
def test_matrices_from_world_to_camera_are_recognised(seed: int, opencv: bool) -> None:
    """Around a subject that is not far from the origin, as they are exported."""
    generator = np.random.default_rng(seed)
    poses = ring(int(generator.integers(6, 30)))
    poses[:, :3, 3] += generator.uniform(-1, 1, 3) - [5, -3, 100]
    assert not looks_inverted(poses)
    assert looks_inverted(np.linalg.inv(poses @ FLIP if opencv else poses))


def test_walks_and_pans_are_not_taken_for_inverses() -> None:
    generator = np.random.default_rng(1)
    for _ in range(50):
        poses = ring(40, outwards=True)
        poses[:, :3, 3] = generator.uniform(-5, 5, (40, 3)) + generator.uniform(-20, 20, 3)
        assert not looks_inverted(poses)


def test_sparse_points_decide_before_the_focus() -> None:
    """Cameras that look out of a room, at points on its walls."""
    poses = ring(50, outwards=True, radius=0.5)
    assert looks_away(poses)
    angles = torch.linspace(0, math.tau, 300)
    walls = torch.stack([5 + 20 * angles.cos(), -3 + 20 * angles.sin(), torch.full_like(angles, 100.0)], -1)
    assert not looks_away(poses, walls)
    inside = ring(10)
    assert looks_away(inside @ FLIP, torch.tensor([[5.0, -3, 100]]))


@pytest.mark.parametrize("name", ["blender", "transforms"])
def test_opencvs_axes_are_refused_with_the_switch_and_taken_with_it(tmp_path: Path, name: str) -> None:
    plain = read_capture(data_folders.WRITERS[name](tmp_path / "plain"))
    root = data_folders.WRITERS[name](tmp_path / "scene")
    file = next(root.glob("transforms*.json"))
    fields = json.loads(file.read_text())
    for frame in fields["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ FLIP).tolist()
    file.write_text(json.dumps(fields))
    with pytest.raises(ValueError, match=r"look away from what they surround; set data.axes=opencv if"):
        read_capture(root)
    split = "train" if name == "blender" else "all"
    poses = [frame.pose for frame in read_capture(root, axes="opencv").splits[split]]
    assert poses == [frame.pose for frame in plain.splits[split]]
    backwards = read_capture(root, axes="opengl").splits[split]
    assert [frame.pose for frame in backwards] != poses
