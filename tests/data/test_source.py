"""Data sources: which frames may be trained on."""

import pytest
import torch

from dnerf.data import BlenderData, DataSource, SyntheticData, save_blender
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


@pytest.mark.parametrize("split", ["val", "test"])
def test_other_splits_stay_whole(make, split):
    assert torch.equal(make(train_end=0.8).frames(split).times, make().frames(split).times)


def test_an_end_at_the_first_frame_keeps_it(make):
    # The first training frame has time 0.
    assert len(make(train_end=0.0).frames("train")) == 1


@pytest.mark.parametrize("train_end", [-0.1, 1.1])
def test_a_time_outside_the_film_is_refused(make, train_end):
    with pytest.raises(ValueError, match=r"train_end must be in \[0, 1\] or None"):
        make(train_end=train_end)
