"""Data sets as people export them stand in the world alike, whatever their units; what is doubtful is said."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from dnerf.data import FolderData, random_views, render_frames, save_blender
from dnerf.data.background_check import data_background
from dnerf.data.bounds import opaque_without_room
from dnerf.scenes import make_scene

Y_UP = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
TILTED = torch.linalg.matrix_exp(torch.tensor([[0.0, 0, 0.4], [0, 0, -0.3], [-0.4, 0.3, 0]], dtype=torch.float64))
IDENTITY = torch.eye(3, dtype=torch.float64)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """16 + 3 images of 32 x 32 of a walker, in D-NeRF's format without near and far."""
    root = tmp_path_factory.mktemp("cases") / "plain"
    scene = make_scene("walker")
    splits = {}
    for split, count, seed in (("train", 16, 0), ("test", 3, 7)):
        poses, times = random_views(count, midway=split == "test", seed=seed)
        splits[split] = render_frames(scene, poses, times, 32)
    save_blender(splits, root)
    edit(root, lambda top: [top.pop(key) for key in ("near", "far")])
    return root


def edit(root: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    for path in root.glob("transforms_*.json"):
        top = json.loads(path.read_text())
        change(top)
        path.write_text(json.dumps(top))


def edit_frames(root: Path, change: Callable[[int, dict[str, Any]], Any]) -> None:
    edit(root, lambda top: [change(index, frame) for index, frame in enumerate(top["frames"])])


@pytest.fixture
def root(plain: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(plain, tmp_path / "scene"))


def move(root: Path, scale: float, turn: torch.Tensor = IDENTITY, shift: tuple[float, ...] = (0.0, 0.0, 0.0)) -> None:
    def change(_: int, frame: dict[str, Any]) -> None:
        pose = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] = scale * (turn @ pose[:3, 3]) + torch.tensor(shift, dtype=torch.float64)
        frame["transform_matrix"] = pose.tolist()

    edit_frames(root, change)


@pytest.mark.parametrize(("scale", "turn", "shift"), [
    (1e-3, IDENTITY, (0.0, 0.0, 0.0)), (0.4, IDENTITY, (12.0, -7.0, 3.0)),
    (50.0, Y_UP, (0.0, 0.0, 0.0)), (1e3, Y_UP, (4e5, -5e6, 120.0)),
    (2.0, TILTED, (1.0, 2.0, 3.0)),
])  # fmt: skip
def test_units_origin_and_up_do_not_change_what_is_learnt(
    plain: Path, root: Path, scale: float, turn: torch.Tensor, shift: tuple[float, ...]
) -> None:
    move(root, scale, turn, shift)
    source, other = FolderData(plain), FolderData(root)
    expected, frames = source.frames("train"), other.frames("train")
    tolerance = 2e-3 if turn is TILTED else 2e-5  # box axes of the tilted one are turned by what cameras are held by
    torch.testing.assert_close(frames.poses, expected.poses, rtol=0, atol=tolerance)
    torch.testing.assert_close(
        torch.tensor(other.world().box), torch.tensor(source.world().box), rtol=0, atol=max(tolerance, 1.01e-3)
    )
    assert frames.near == pytest.approx(expected.near, abs=2e-3)
    assert frames.far == pytest.approx(expected.far, abs=2e-3)
    assert torch.equal(frames.images, expected.images)
    # Exports are in the data set's own units again.
    own = other.world().similarity.poses_from_world(frames.poses)
    stated = json.loads((root / "transforms_train.json").read_text())["frames"]
    for pose, frame in zip(own, stated):
        there = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        torch.testing.assert_close(pose[:3, 3], there[:3, 3], rtol=1e-6, atol=1e-5 * scale)


def test_the_box_stands_at_the_origin_and_holds_what_images_show(plain: Path) -> None:
    source = FolderData(plain)
    low, high = torch.tensor(source.world().box)
    assert torch.equal(low, -high)
    assert float((high - low).max()) == 2.5
    assert opaque_without_room(source.frames("train"), torch.tensor(source.world().box)) == 0
    assert source.world().warnings == ()


@pytest.mark.parametrize("power", [-9, 0, 5])
def test_images_are_bit_identical_where_nothing_is_normalised_but_by_a_power_of_two(
    plain: Path, root: Path, power: int
) -> None:
    """Rays, and so images, are those of the file's own units, times that power."""
    half = 1.25 * 2.0**power
    move(root, 2.0**power)
    frames = FolderData(root, box=[[-half] * 3, [half] * 3], near=2.0 * 2.0**power, far=6.0 * 2.0**power).frames(
        "train"
    )
    before = json.loads((plain / "transforms_train.json").read_text())["frames"]
    poses = torch.tensor([frame["transform_matrix"] for frame in before])
    assert torch.equal(frames.poses, poses)
    assert (frames.near, frames.far) == (2.0, 6.0)


def test_given_planes_and_box_are_in_the_data_s_units(root: Path) -> None:
    move(root, 50.0)
    box = [[-60.0, -60.0, -100.0], [60.0, 60.0, 80.0]]
    source = FolderData(root, box=box, near=90.0, far=310.0)
    frames, world = source.frames("train"), source.world()
    assert world.similarity.scale == pytest.approx(2.5 / 180)
    torch.testing.assert_close(world.similarity.box_from_world(world.box), torch.tensor(box).double())
    assert (frames.near, frames.far) == pytest.approx((90 * 2.5 / 180, 310 * 2.5 / 180))


@pytest.mark.parametrize(("scale", "settings", "said"), [
    (
        0.4,
        {"near": 1.5},
        r"data.near=1.5 cuts off what the images show, which begins at about (1\.\d+|0\.9\d*): set",
    ),
    (1.0, {"far": 4.2}, r"data.far=4.2 cuts off"),
    (1.0, {"box": [[-0.3] * 3, [0.3] * 3]}, r"% of the opaque pixels look past data.box.*set data.box=\[\["),
])  # fmt: skip
def test_settings_that_cut_off_what_images_show_are_told_with_a_value(root, scale, settings, said) -> None:
    move(root, scale)
    (warning,) = FolderData(root, **settings).world().warnings
    assert re.search(said, warning), warning


def test_planes_beside_what_cameras_look_at_are_told(root: Path) -> None:
    said = FolderData(root, near=4.5).world().warnings
    assert any("data.near=4.5 lies behind what the cameras look at, in a depth of 4: set it to null" in w for w in said)


def on(root: Path, color: float, suffix: str) -> None:
    """Opaque images before one grey."""
    for split in ("train", "test"):
        for path in (root / split).glob("*.png"):
            image = Image.open(path).convert("RGBA")
            ground = Image.new("RGBA", image.size, (round(255 * color),) * 3 + (255,))
            path.unlink()
            Image.alpha_composite(ground, image).convert("RGB").save(path.with_suffix(suffix), quality=95)


@pytest.mark.parametrize(("suffix", "color"), [(".jpg", 1.0), (".png", 0.0), (".png", 0.4)])
def test_opaque_images_before_one_colour_train_without_being_told_which(plain, root, suffix, color) -> None:
    on(root, color, suffix)
    source = FolderData(root)
    found, _ = data_background(source.frames("train"))
    assert found == pytest.approx([color] * 3, abs=0.01)
    # As tight a box as with alpha, to a few pixels.
    assert source.world().similarity.scale == pytest.approx(FolderData(plain).world().similarity.scale, rel=0.12)


def test_planes_of_the_files_that_cameras_do_not_look_at_are_left_alone(plain: Path, root: Path) -> None:
    """Such as D-NeRF's 2 and 6, copied into a scene of other units."""
    move(root, 50.0)
    edit(root, lambda top: top.update(near=2.0, far=6.0))
    assert FolderData(root).world().box == FolderData(plain).world().box


def test_the_box_of_cameras_amid_things_is_around_what_they_go_around_however_far_the_files_see(root: Path) -> None:
    """Images that show something everywhere; a given far plane still says where the box ends."""
    for path in (root / "train").glob("*.png"):
        Image.fromarray(torch.randint(0, 256, (32, 32, 3), dtype=torch.uint8).numpy()).save(path)
    edit(root, lambda top: top.update(near=0.1, far=60.0))
    worlds = [FolderData(root, far=far).world() for far in (None, 60.0)]
    found, given = (2.5 / world.similarity.scale for world in worlds)
    assert found < 12
    assert given > 40
