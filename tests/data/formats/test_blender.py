import json
import math
import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dnerf.core.cameras import Intrinsics, look_at
from dnerf.data.formats.legacy import load_blender
from dnerf.data.formats.writers import save_blender
from dnerf.data.frames import Frames
from dnerf.data.images import premultiplied_area_average

Scene = Callable[..., Path]


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


def straight_pixels(root: Path, index: int) -> np.ndarray:
    return np.asarray(Image.open(root / "train" / f"r_{index}.png"))


def test_frames_are_read_premultiplied(make_scene: Scene) -> None:
    root = make_scene()
    frames = load_blender(root, "train")
    assert frames.images.shape == (3, 6, 8, 4)
    for i in range(3):
        straight = straight_pixels(root, i).astype(float) / 255
        on_white = straight[..., :3] * straight[..., 3:] + 1 - straight[..., 3:]
        # colour times alpha is rounded to 8 bits once
        assert np.abs(frames.image(i, torch.ones(3)).numpy() - on_white).max() <= 0.5 / 255 + 1e-6
    assert frames.times.tolist() == [0, 0.5, 1]
    assert frames.names == ("train/r_0", "train/r_1", "train/r_2")
    assert (frames.near, frames.far) == (2.0, 6.0)
    assert frames.shared_intrinsics == Intrinsics.from_angle(8, 6, 0.7)


@pytest.mark.parametrize(("resolution", "height"), [(8, 6), (4, 3), (5, 4), (3, 2), (1, 1)])
def test_resolution_is_a_width_with_height_and_focal_in_proportion(
    make_scene: Scene, resolution: int, height: int
) -> None:
    root = make_scene()
    frames = load_blender(root, "train", resolution)
    assert frames.images.shape == (3, height, resolution, 4)
    for i in range(3):
        expected = premultiplied_area_average(straight_pixels(root, i), resolution, height)
        np.testing.assert_array_equal(frames.images[i].numpy(), expected)
    assert frames.shared_intrinsics == Intrinsics.from_angle(8, 6, 0.7).resized(resolution, height)


def test_arguments_come_before_the_file(make_scene: Scene) -> None:
    root = make_scene(lambda m: m.update(near=1, far=3, pixel_origin="corner"))
    frames = load_blender(root, "train")
    assert (frames.near, frames.far, frames.intrinsics[0].pixel_origin) == (1, 3, "corner")
    frames = load_blender(root, "train", near=0.25, far=9, pixel_origin="center")
    assert (frames.near, frames.far, frames.intrinsics[0].pixel_origin) == (0.25, 9, "center")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda image: image.unlink(), r"frames\[1\].file_path: no image .*train/r_1"),
        (
            lambda image: Image.new("RGBA", (8, 7)).save(image),
            r"frames\[1\].file_path: image must be 8 x 6 as the first, got 8 x 7 in .*r_1.png",
        ),
        (lambda image: image.write_bytes(image.read_bytes()[:150]), r"r_1.png: image is truncated or broken"),
        (lambda image: image.write_text("<html>404</html>"), r"r_1.png: image must be a PNG or JPEG file"),
        (
            lambda image: (image.parents[1] / "transforms_train.json").unlink(),
            r"transforms_train.json: file does not exist",
        ),
    ],
)
def test_spoilt_scenes_are_refused_in_one_line(
    make_scene: Scene, spoil: Callable[[Path], object], message: str
) -> None:
    root = make_scene()
    spoil(root / "train" / "r_1.png")
    with pytest.raises(ValueError, match=message) as caught:
        load_blender(root, "train")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"resolution": 9}, "resolution must be at most the images' width 8"),
        ({"resolution": 0}, "resolution must be > 0"),
        ({"resolution": 7.9}, "resolution must be a whole number, got 7.9"),
        ({"split": "../train"}, "split must be a plain name"),
        ({"split": ""}, "split must be a plain name"),
        ({"split": "test"}, "transforms_test.json: file does not exist"),
        ({"max_bytes": 500}, "3 frames of 8 x 6 take 576 bytes, more than max_bytes = 500"),
        ({"near": 7.0}, "near and far must satisfy"),
        ({"pixel_origin": "middle"}, "pixel_origin must be one of"),
        ({"root": Path("none")}, r"root must be a data set's folder, got none"),
    ],
)
def test_senseless_arguments_are_refused(make_scene: Scene, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_blender(**{"root": make_scene(), "split": "train", **arguments})


def test_memory_of_reading_is_that_of_the_result_and_a_few_images(make_scene: Scene) -> None:
    root = make_scene(num_frames=60, height=256, width=256)
    peaks = []
    # Anything else that runs in this process can only add to a peak.
    for _ in range(3):
        tracemalloc.start()
        frames = load_blender(root, "train", 32)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert frames.images.shape == (60, 32, 32, 4)
    # 0.25 MiB for the result, and in each of four threads about 1.5 MiB for an image of 0.25 MiB and its products;
    # all 60 images would take 15 MiB as bytes and 60 MiB as floats.
    assert min(peaks) < 10 * 2**20


@given(num_frames=st.integers(1, 3), channels=st.sampled_from([3, 4]), seed=st.integers(0, 2**31))
def test_what_is_written_is_read_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, num_frames: int, channels: int, seed: int
) -> None:
    frames = random_frames(num_frames, channels, seed)
    root = tmp_path_factory.mktemp("written") / "scene"
    save_blender({"train": frames}, root)
    assert_same(load_blender(root, "train"), frames)


@pytest.mark.parametrize(
    "changes",
    [
        {"intrinsics": Intrinsics(8, 6, 7.1, 8.3, 3.9, 3.3, "corner"), "near": 0.1, "far": 1e3},
        {"channels": 3, "background": (1.0, 0.5, 0.25)},
    ],
)
def test_extra_fields_survive(tmp_path: Path, changes: dict[str, Any]) -> None:
    frames = random_frames(**changes)
    save_blender({"test": frames}, tmp_path / "scene")
    assert_same(load_blender(tmp_path / "scene", "test"), frames)


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
    assert (load_blender(tmp_path / "a", "train").images == 100).all()
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
        assert len(load_blender(root, "train")) == 3
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    save_blender({"train": random_frames()}, tmp_path / "link")
    assert len(load_blender(tmp_path / "elsewhere", "train")) == 3


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


def real_scene(name: str) -> Path:
    if "DNERF_DATA" not in os.environ:
        pytest.skip("DNERF_DATA is not set")
    return Path(os.environ["DNERF_DATA"]) / name


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "counts"), [("jumpingjacks", (200, 20, 20)), ("mutant", (150, 20, 20)), ("lego", (50, 11, 20))]
)
def test_real_scenes_have_the_published_facts(name: str, counts: tuple[int, int, int]) -> None:
    root = real_scene(name)
    for split, count in zip(("train", "val", "test"), counts):
        frames = load_blender(root, split, 40)
        assert len(frames) == count
        assert frames.has_alpha
        assert frames.images.shape[1:] == (40, 40, 4)
        assert (float(frames.times.min()), float(frames.times.max())) == (0, 1)
        assert (frames.times.diff() > 0).all()
        # 0.5 width / tan(0.5 * 0.6911112), known from NeRF's scenes as 1111.11 at 800
        assert frames.intrinsics[0].focal_x * 20 == pytest.approx(1111.111, abs=1e-3)
        rays = frames.camera(0).rays(0.0)
        # z-depths 2 and 6 are longer along slanted rays: the corner pixel's by 1 / cos
        corner = math.sqrt(1 + 2 * (19.5 / frames.intrinsics[0].focal_x) ** 2)
        assert float(rays.near[0]) == pytest.approx(2 * corner, rel=1e-6)
        assert float(rays.far[0]) == pytest.approx(6 * corner, rel=1e-6)
        # the cameras stand about 4 away and look at the scene near the origin
        to_origin = -frames.poses[:, :3, 3] / frames.poses[:, :3, 3].norm(dim=-1, keepdim=True)
        assert float((to_origin * -frames.poses[:, :3, 2]).sum(-1).min()) > 0.9


@pytest.mark.real_data
def test_a_real_image_on_white_is_the_area_average_of_the_whole_one() -> None:
    root = real_scene("mutant")
    frames = load_blender(root, "val", 400)
    assert frames.images.numel() == 20 * 400 * 400 * 4
    straight = np.asarray(Image.open(root / "val" / "r_007.png")).astype(float) / 255
    on_white = straight[..., :3] * straight[..., 3:] + 1 - straight[..., 3:]
    averaged = on_white.reshape(400, 2, 400, 2, 3).mean((1, 3))
    # two roundings to 8 bits, of colour and of alpha
    assert np.abs(frames.image(7, torch.ones(3)).numpy() - averaged).max() <= 1 / 255 + 1e-6
    assert float(frames.image(7, torch.ones(3)).mean()) == pytest.approx(averaged.mean(), abs=1e-4)
    assert 0.8 < averaged.mean() < 0.99
