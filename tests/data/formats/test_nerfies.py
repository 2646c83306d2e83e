import json
from pathlib import Path
from typing import Any

import data_folders
import numpy as np
import pytest
import torch

from dnerf.core.cameras import Camera
from dnerf.core.lenses import Distortion
from dnerf.data.formats import read_capture


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return data_folders.write_nerfies(tmp_path / "scene")


def edit(path: Path, **changes: Any) -> None:
    value = json.loads(path.read_text())
    value.update(changes)
    path.write_text(json.dumps({key: entry for key, entry in value.items() if entry is not ...}))


def test_a_point_in_front_lands_where_nerfies_projects_it(root: Path) -> None:
    """`pixel = focal * [x, aspect * y] / z + principal point`, with `x = orientation @ (point - position)`."""
    turned = [[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]
    changes: dict[str, Any] = {"pixel_aspect_ratio": 1.25, "principal_point": [3.0, 2.5]}
    edit(root / "camera/000000.json", orientation=turned, position=[1.0, 2, 3], **changes)
    frame = read_capture(root).splits["train"][0]
    point = np.array([6.0, 2.5, 3.25])
    x, y, z = np.array(turned) @ (point - [1, 2, 3])
    expected = (9.5 * x / z + 3.0, 9.5 * 1.25 * y / z + 2.5)
    pose = np.array(frame.pose)
    right, up, back = pose[:3, :3].T @ (point - pose[:3, 3])
    focal_x, focal_y, column, row = frame.intrinsics.pinhole  # of pixel centres, half a pixel before
    assert (focal_x * right / -back + column + 0.5, row + 0.5 - focal_y * up / -back) == pytest.approx(expected)


def test_lenses_and_both_names_of_tangential_coefficients_are_used(root: Path) -> None:
    edit(root / "camera/000001.json", radial_distortion=[0.1, -0.01, 0], tangential_distortion=[0.001, 0.002])
    edit(root / "camera/000002.json", tangential_distortion=..., tangential=[0.001, 0.002])
    lenses = [frame.intrinsics.distortion for frame in read_capture(root).splits["train"]]
    assert lenses[0] is None
    assert lenses[1] == Distortion("opencv", (0.1, -0.01, 0.0), (0.001, 0.002))
    assert lenses[2] == Distortion("opencv", (0.0, 0.0, 0.0), (0.001, 0.002))


def test_a_phones_lens_that_moves_the_corners_inwards_does_not_fold(root: Path) -> None:
    """HyperNeRF's cake: tangential terms take more of the corner than the radial ones leave room for."""
    edit(
        root / "camera/000001.json", image_size=[480, 856], focal_length=716.3578, principal_point=[310.0815, 453.308],
        radial_distortion=[0.0955, -0.2321, 0.0], tangential_distortion=[0.0024941, 0.030058],
    )  # fmt: skip
    frame = read_capture(root).splits["train"][1]
    camera = Camera(frame.intrinsics, torch.tensor(frame.pose, dtype=torch.float64), 1.0, 2.0)
    corners = torch.tensor([0, 479, 855 * 480, 856 * 480 - 1])
    rays = camera.rays(0.0, corners)
    pixels = camera.project(rays.origins + 5 * rays.directions)[0]
    expected = torch.stack([corners % 480, corners // 480], -1).double()
    torch.testing.assert_close(pixels, expected, atol=1e-6, rtol=0)  # the lens is inverted to 1e-6 pixels


def test_frames_for_validation_are_the_test_split(root: Path) -> None:
    edit(root / "dataset.json", train_ids=["000000", "000003"], val_ids=["000001"])
    splits = read_capture(root).splits
    assert {split: [f.name for f in frames] for split, frames in splits.items()} == {
        "train": ["000000", "000003"], "test": ["000001"]
    }  # fmt: skip
    edit(root / "dataset.json", train_ids=..., val_ids=...)
    assert {split: len(frames) for split, frames in read_capture(root).splits.items()} == {"all": 4}


@pytest.mark.parametrize(("metadata", "times"), [
    ([0, 1, 2, 3], [0, 1, 2, 3]),
    ([0, 0, 1, 2], [0, 1, 2, 3]),  # the frame for validation carries its neighbour's embedding
    ([0, 1, 0, 1], [0, 1, 0, 1]),  # two cameras: names number the images, not the moments
    (None, [0, 1, 2, 3]),
])  # fmt: skip
def test_times_are_numbers_in_names_unless_metadata_disagrees(root: Path, metadata: Any, times: list) -> None:
    edit(root / "dataset.json", train_ids=["000000", "000002", "000003"], val_ids=["000001"])
    ids = [f"{index:06d}" for index in range(4)]
    if metadata is None:
        (root / "metadata.json").unlink()
    else:
        embeddings = {name: {"warp_id": number} for name, number in zip(ids, metadata)}
        (root / "metadata.json").write_text(json.dumps(embeddings))
    found = {f.name: f.time for frames in read_capture(root).splits.values() for f in frames}
    assert [found[name] for name in ids] == times


def test_points_and_up_are_read_in_the_cameras_units(root: Path) -> None:
    np.save(root / "points.npy", data_folders.POINTS.astype(np.float32))
    (root / "extra.json").write_text(json.dumps({"up": [0, -2, 0], "fps": 30}))
    capture = read_capture(root)
    assert capture.points is not None
    np.testing.assert_allclose(capture.points.numpy(), data_folders.POINTS, rtol=1e-6)
    assert capture.up == (0, -1, 0)


@pytest.mark.parametrize(("file", "changes", "message"), [
    ("dataset.json", {"train_ids": ["../x"]}, r"train_ids\[0\] must be a plain name such as 000001, got '../x'"),
    ("dataset.json", {"train_ids": "all"}, "train_ids must be a list of at most"),
    ("dataset.json", {"train_ids": ..., "ids": []}, "ids must name at least one frame"),
    ("dataset.json", {"train_ids": ["000009"]}, "no image of dataset.json is there, looked for rgb/1x/000009.png"),
    ("camera/000002.json", {"orientation": ...}, r"000002.json.orientation is missing"),
    ("camera/000002.json", {"orientation": [[1, 0], [0, 1]]}, "orientation must be a list of 3 lists of 3"),
    ("camera/000002.json", {"orientation": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}, "orientation must be rigid"),
    ("camera/000002.json", {"image_size": [8, 6.5]}, r"image_size\[1\] must be a whole number"),
    ("camera/000002.json", {"image_size": 8}, "image_size must be a list of width and height"),
    ("camera/000002.json", {"skew": 3.0}, "skew must be 0, got 3"),
    ("camera/000002.json", {"focal_length": 0}, "focal_length must be a number"),
    ("camera/000002.json", {"radial_distortion": [0]}, "radial_distortion must be a list of 3 numbers"),
    ("camera/000002.json", {"radial_distortion": [-9.0, 0, 0]}, "000002.json: "),
    ("scene.json", {"scale": 0}, "scale must be a number"),
    ("scene.json", {"near": 9}, "near must be less than far"),
])  # fmt: skip
def test_bad_fields_are_named_in_one_line(root: Path, file: str, changes: dict, message: str) -> None:
    edit(root / file, **changes)
    with pytest.raises(ValueError, match=message) as caught:
        read_capture(root)
    assert "\n" not in str(caught.value)
    assert str(root) in str(caught.value)


def test_links_out_of_the_folder_are_refused(root: Path, tmp_path: Path) -> None:
    image = root / "rgb/2x/000001.png"
    image.rename(tmp_path / "outside.png")
    image.symlink_to(tmp_path / "outside.png")
    with pytest.raises(ValueError, match="must stay inside the data set's folder, got a link out of it"):
        read_capture(root)
