"""Every data set of `data_cases` is understood as what it was made of, or refused in words that say how to go on.

The number before a case's name tells cases apart and stays with its case when others come or go; it says nothing else.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from data_cases import CASES, Case, look

from dnerf.data import FolderData, Frames
from dnerf.data.background_check import data_background
from dnerf.data.normalization import Similarity
from dnerf.data.scene_record import SceneRecord
from dnerf.data.source import NoImages

LUMA = np.array([299, 587, 114]) / 1000  # ITU-R 601-2, what Pillow's grey is


def assert_shows_the_ball(case: Case, frames: Frames, similarity: Similarity, behind: tuple | None) -> np.ndarray:
    """Every pixel is what its ray shows at its time, back in the units of the ball; where it is hit, in the world."""
    rays, rgba = frames.pixels(torch.arange(frames.num_pixels))

    def own(positions: torch.Tensor) -> np.ndarray:
        return (similarity.positions_from_world(positions).numpy() - case.shift) / case.scale

    origins = own(rays.origins)
    directions = own(rays.origins.double() + rays.directions) - origins
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    times = rays.times.double().numpy() if case.moment is None else np.full(len(rays), case.moment)
    truth, hit = look(origins, directions, times)
    color, alpha = truth[:, :3], truth[:, 3:]
    if case.grey:
        color = np.repeat(color @ LUMA[:, None], 3, -1)
    if behind is None:
        expected = np.concatenate([color * alpha, alpha], -1)
    else:
        expected = np.concatenate([color * alpha + (1 - alpha) * behind, np.ones_like(alpha)], -1)
    np.testing.assert_allclose(255 * rgba.double().numpy(), 255 * expected, atol=case.levels, rtol=0)
    depth = ((hit - origins) * directions).sum(-1) * case.scale * similarity.scale
    seen = alpha[:, 0] > 0
    assert 0.1 < seen.mean() < 0.9
    assert (depth[seen] > rays.near.numpy()[seen]).all()
    assert (depth[seen] < rays.far.numpy()[seen]).all()
    return similarity.positions_to_world(torch.from_numpy(case.scale * hit[seen] + case.shift)).numpy()


@pytest.mark.parametrize("name", CASES)
def test_people_s_own_data_sets_are_what_they_were_made_of(tmp_path: Path, name: str) -> None:
    case, root = CASES[name], tmp_path / "scene"
    case.make(root)
    if case.refused:
        with pytest.raises(ValueError, match=case.refused) as caught:
            FolderData(root).frames("train")
        assert "\n" not in str(caught.value)
        if not any(case.count):
            return
    source = FolderData(root, **case.settings)
    world = source.world()
    spoken = "\n".join([*world.notes, *world.warnings])
    assert case.said in spoken
    record = source.record()
    for split, count in zip(("train", "test"), case.count):
        if not count:
            with pytest.raises(NoImages, match="can be filmed"):
                source.frames(split)
            continue
        frames = source.frames(split)
        assert len(frames) == count
        behind = case.behind if split == "train" or case.behind_test is None else case.behind_test
        places = assert_shows_the_ball(case, frames, world.similarity, behind)
        if split == "train":
            assert (np.abs(places) <= np.array(world.box[1])).all()
            assert data_background(frames)[0] == (None if behind is None else pytest.approx(behind, abs=0.01))
        elif case.behind_test is not None:
            assert frames.background == case.behind_test
        torch.testing.assert_close(record.cameras[split].poses, frames.poses)
        torch.testing.assert_close(record.cameras[split].times, frames.times)
        assert record.cameras[split].intrinsics == frames.intrinsics


def test_equal_intrinsics_of_every_frame_are_one_camera(tmp_path: Path) -> None:
    for name, expected in (("01-intrinsics-in-every-frame", True), ("48-matrix-k-in-every-frame", False)):
        CASES[name].make(tmp_path / name)
        assert (FolderData(tmp_path / name).frames("train").shared_intrinsics is not None) == expected


def test_a_run_knows_its_cameras_when_the_data_are_gone(tmp_path: Path) -> None:
    root = tmp_path / "scene"
    CASES["46-data-gone"].make(root)
    record = FolderData(root).record()
    record.write(tmp_path)
    shutil.rmtree(root)
    again = SceneRecord.read(tmp_path)
    assert again.world == record.world
    assert torch.equal(again.cameras["test"].poses, record.cameras["test"].poses)
    with pytest.raises(ValueError, match="root must be a data set's folder"):
        FolderData(root).frames("test")
