"""Data sources: which frames may be trained on, in which box, and whether they have alpha."""

import shutil
from pathlib import Path

import pytest
import torch
from PIL import Image

from dnerf.data import BlenderData, DataSource, SyntheticData, save_blender
from dnerf.data.bounds import fit_box
from dnerf.scenes import make_scene


def synthetic(**arguments) -> SyntheticData:
    return SyntheticData(make_scene("static"), 8, num_train=11, num_val=4, num_test=5, **arguments)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "scene"
    source = synthetic()
    save_blender({split: source.frames(split) for split in ("train", "val", "test")}, root)
    return root


@pytest.fixture(params=["synthetic", "blender"])
def make(request, folder):
    if request.param == "synthetic":
        return synthetic
    return lambda **arguments: BlenderData(str(folder), None, **arguments)


def test_training_ends_where_it_is_told_to(make):
    whole, part = make(), make(train_end=0.8)
    assert isinstance(part, DataSource)
    kept = whole.frames("train").times <= 0.8
    assert 0 < int(kept.sum()) < 11
    assert torch.equal(part.frames("train").times, whole.frames("train").times[kept])
    assert torch.equal(part.frames("train").images, whole.frames("train").images[kept])
    for split in ("val", "test"):
        assert torch.equal(part.frames(split).times, whole.frames(split).times)
    # The first training frame has time 0.
    assert len(make(train_end=0.0).frames("train")) == 1


@pytest.mark.parametrize("train_end", [-0.1, 1.1])
def test_a_time_outside_the_film_is_refused(make, train_end):
    with pytest.raises(ValueError, match=r"train_end must be in \[0, 1\] or None"):
        make(train_end=train_end)


def test_a_given_box_stays_and_another_is_fitted_and_rounded_outwards(make):
    box = [[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]]
    frames = make().frames("train")
    assert make(box=box).fitted_box(frames) == box
    source = make()
    assert source.box is None
    found, exact = torch.tensor(source.fitted_box(frames)), fit_box(frames)
    assert (found[0] <= exact[0]).all()
    assert (found[1] >= exact[1]).all()
    torch.testing.assert_close(found, exact, rtol=0, atol=1.001e-3)  # four digits of about 3 units
    assert [[round(x, 3) for x in corner] for corner in source.fitted_box(frames)] == source.fitted_box(frames)


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


@pytest.mark.parametrize("change", [opaque, lambda image: image.convert("RGB")])
@pytest.mark.parametrize("split", ["val", "test"])
def test_training_images_decide_for_all_splits_whether_there_is_alpha(folder, tmp_path, change, split):
    root = Path(shutil.copytree(folder, tmp_path / "scene"))
    images_of(root, split, change)
    assert (BlenderData(root, None).frames(split).images[..., 3] == 255).all()
    images_of(root, "train", opaque)
    data = BlenderData(root, None)
    assert not data.frames(split).has_alpha
    assert not data.frames("train").has_alpha


def test_transparent_images_are_refused_beside_opaque_training_images(folder, tmp_path):
    root = Path(shutil.copytree(folder, tmp_path / "scene"))
    images_of(root, "train", opaque)
    with pytest.raises(ValueError, match=r"test/r_000.png: image must be opaque, as the training images are"):
        BlenderData(root, None).frames("test")
    (root / "transforms_train.json").unlink()
    assert BlenderData(root, None).frames("test").has_alpha
