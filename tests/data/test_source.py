"""Data sources: which frames may be trained on, in which box, and whether they have alpha."""

import shutil
from pathlib import Path

import pytest
import torch
from PIL import Image

from dnerf.data import DataSource, FolderData, SyntheticData, save_blender
from dnerf.data.bounds import fit_box
from dnerf.data.source import NoImages
from dnerf.scenes import make_scene


def synthetic(**arguments) -> SyntheticData:
    return SyntheticData(make_scene("static"), 8, num_train=11, num_val=4, num_test=5, **arguments)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "scene"
    source = synthetic()
    save_blender({split: source.frames(split) for split in ("train", "val", "test")}, root)
    return root


@pytest.fixture(params=["synthetic", "folder"])
def make(request, folder):
    if request.param == "synthetic":
        return synthetic
    return lambda **arguments: FolderData(folder, **arguments)


def test_training_ends_where_it_is_told_to(make):
    whole, part = make(), make(train_end=0.8)
    assert isinstance(part, DataSource)
    kept = whole.frames("train").times <= 0.8
    assert 0 < int(kept.sum()) < 11
    assert torch.equal(part.frames("train").times, whole.frames("train").times[kept])
    assert torch.equal(part.frames("train").images, whole.frames("train").images[kept])
    assert torch.equal(part.record().cameras["train"].times, whole.frames("train").times[kept])
    for split in ("val", "test"):
        assert torch.equal(part.frames(split).times, whole.frames(split).times)
    # The first training frame has time 0.
    assert len(make(train_end=0.0).frames("train")) == 1


def test_frames_after_the_end_of_training_are_not_looked_at_to_place_the_scene(folder, tmp_path):
    root = Path(shutil.copytree(folder, tmp_path / "scene"))
    expected = FolderData(root, train_end=0.5).world()
    for index in range(6, 11):
        Image.new("RGBA", (8, 8), (255, 255, 255, 255)).save(root / "train" / f"r_{index:03d}.png")
    assert FolderData(root, train_end=0.5).world() == expected


@pytest.mark.parametrize("train_end", [-0.1, 1.1])
def test_a_time_outside_the_film_is_refused(make, train_end):
    with pytest.raises(ValueError, match=r"train_end must be in \[0, 1\] or None"):
        make(train_end=train_end)


def test_a_record_holds_the_cameras_of_the_frames(make):
    source = make()
    record = source.record()
    for split, cameras in record.cameras.items():
        frames = source.frames(split)
        assert torch.equal(cameras.poses, frames.poses)
        assert torch.equal(cameras.times, frames.times)
        assert cameras.intrinsics == frames.intrinsics


def test_settled_sources_stand_where_they_are_told_to(make):
    source, other = make(), make(box=[[-2.0, -2.0, -1.0], [1.0, 1.0, 2.0]])
    source.settle(other.world())
    assert source.world() == other.world()
    assert torch.equal(source.frames("test").poses, other.frames("test").poses)


def test_exact_scenes_keep_their_units_and_a_fitted_box_is_rounded_outwards():
    box = [[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]]
    assert synthetic(box=box).world().box == ((-1.0, -2.0, -3.0), (1.0, 2.0, 3.0))
    source = synthetic()
    found, exact = torch.tensor(source.world().box), fit_box(source.frames("train"))
    assert (found[0] <= exact[0]).all()
    assert (found[1] >= exact[1]).all()
    torch.testing.assert_close(found, exact, rtol=0, atol=1.001e-3)  # four digits of about 3 units
    assert source.world().similarity.scale == 1


@pytest.mark.parametrize(
    ("box", "message"), [("tight", "box must be one of auto; got 'tight'"), ([[1, 1, 1], [0, 0, 0]], "low < high")]
)
def test_a_box_that_is_none_is_refused(make, box, message):
    with pytest.raises(ValueError, match=message):
        make(box=box)


def images_of(root, split, change):
    for path in (root / split).glob("*.png"):
        change(Image.open(path).convert("RGBA")).save(path)


def opaque(image):
    image.putalpha(255)
    return image


def test_an_alpha_channel_that_hides_nothing_is_none(folder, tmp_path):
    root = Path(shutil.copytree(folder, tmp_path / "scene"))
    images_of(root, "train", opaque)
    data = FolderData(root)
    assert not data.frames("train").has_alpha
    assert not data.world().has_alpha


def test_opaque_test_images_beside_transparent_training_images_say_what_they_stand_before(folder, tmp_path):
    root = Path(shutil.copytree(folder, tmp_path / "scene"))
    images_of(root, "test", lambda image: image.convert("RGB"))  # saved with black where nothing is
    assert FolderData(root).frames("test").background == (0.0, 0.0, 0.0)
    generator = torch.Generator().manual_seed(0)
    for path in (root / "test").glob("*.png"):
        Image.fromarray(torch.randint(0, 256, (8, 8, 3), generator=generator).byte().numpy()).save(path)
    with pytest.raises(ValueError, match="cannot be compared"):
        FolderData(root).frames("test")


@pytest.mark.parametrize("mode", ["RGBA", "RGB"])
def test_training_images_that_show_nothing_are_refused(folder, tmp_path, mode):
    root = Path(shutil.copytree(folder, tmp_path / "scene"))
    images_of(root, "train", lambda image: Image.new(mode, image.size))
    with pytest.raises(ValueError, match="all pixels of the 11 training images are alike, they show nothing"):
        FolderData(root).frames("train")
    Image.new(mode, (8, 8), "white").save(root / "train/r_007.png")
    assert len(FolderData(root, box=[[-1.0] * 3, [1.0] * 3]).frames("train")) == 11


def test_broken_and_missing_test_images_are_found_before_training(folder, tmp_path):
    root = Path(shutil.copytree(folder, tmp_path / "scene"))
    FolderData(root).check("test")
    image = sorted((root / "test").glob("*.png"))[1]
    whole = image.read_bytes()
    image.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=f"{image.name}: image is truncated or broken"):
        FolderData(root).check("test")
    FolderData(root).check("train")
    image.unlink()
    with pytest.raises(ValueError, match=f"{image.stem}: image does not exist"):
        FolderData(root).check("test")


def test_splits_without_images_have_cameras_and_no_frames(folder, tmp_path):
    root = Path(shutil.copytree(folder, tmp_path / "scene"))
    shutil.rmtree(root / "test")
    data = FolderData(root)
    assert not data.cameras()["test"].have_images
    with pytest.raises(NoImages, match="5 cameras of the test split have no images"):
        data.frames("test")
    (root / "transforms_test.json").unlink()
    (root / "transforms_val.json").unlink()
    assert len(FolderData(root).frames("test")) == 1
    with pytest.raises(NoImages, match=r"data\.hold_out=8"):
        FolderData(root, hold_out=None).check("test")


@pytest.mark.parametrize(("arguments", "message"), [
    ({"near": -1.0}, "near must be >= 0"),
    ({"near": 3.0, "far": 2.0}, "near must be less than far"),
    ({"hold_out": 0}, "hold_out must be > 0"),
    ({"times": "now"}, "times must be one of auto, order, static"),
    ({"axes": "left"}, "axes must be one of"),
    ({"format": "none"}, "format must be one of"),
    ({"pixel_origin": "left"}, "pixel_origin must be one of"),
    ({"resolution": 9}, "resolution must be at most the images' width 8"),
    ({"box": [[9.0, 9, 9], [10, 10, 10]]}, "box must be seen by some camera|box lies elsewhere"),
    ({"near": 50.0}, "near must be less than far, got 50"),
])  # fmt: skip
def test_settings_that_make_no_sense_are_refused(folder, arguments, message):
    with pytest.raises(ValueError, match=message):
        FolderData(folder, **arguments).frames("train")
