"""The training loop: spikes, not-a-numbers, collapse, empty pictures, bfloat16, hard scenes."""

import copy
import math

import pytest
import torch

from dnerf.backgrounds import RandomBackground
from dnerf.data import render_frames
from dnerf.data.synthetic import random_views
from dnerf.deformations import DisplacementDeformation
from dnerf.fields import DeformedField, GridField
from dnerf.recovery import Recovery
from dnerf.renderer import Renderer
from dnerf.samplers import OccupancySampler, StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.training import Trainer

BOX = [[-1.5] * 3, [1.5] * 3]
LEARNING_RATES = {"": 1e-2, "field.deformation": 1e-3}


def frames_of(name: str, resolution: int = 16, count: int = 4):
    return render_frames(make_scene(name), *random_views(count), resolution)


def small_renderer(precision: str = "float32", occupancy: bool = False) -> Renderer:
    torch.manual_seed(0)
    deformation = DisplacementDeformation(2, 16, (), position_frequencies=2, time_frequencies=3)
    field = DeformedField(deformation, GridField(BOX, (8, 16), 8, hidden_features=16, num_layers=1))
    sampler = OccupancySampler(BOX, 0.1, 16, num_slabs=4) if occupancy else StratifiedSampler(24, BOX)
    return Renderer(field, sampler, RandomBackground(), precision=precision)


def trainer(**options) -> Trainer:
    defaults = {
        "num_steps": 60, "num_rays": 64, "log_every": 5, "progress_bar": False, "learning_rates": LEARNING_RATES,
        "recovery": Recovery(keep_every=5, patience=3),
    }  # fmt: skip
    return Trainer(**{**defaults, **options})


@pytest.fixture(scope="module")
def frames():
    return frames_of("static")


@torch.no_grad()
def break_once(at: int, change):
    """A callback that spoils the model once."""
    steps = []

    def callback(record, renderer):
        steps.append(record.step)
        if record.step == at:
            change(renderer)

    return callback, steps


def to_nan(renderer):
    renderer.field.deformation.mlp.output.weight.data[0, 0] = math.nan


def explode(renderer):
    for parameter in renderer.parameters():
        parameter.data.mul_(1e25)


def empty(renderer):
    renderer.field.canonical.head.output.weight.data.zero_()
    renderer.field.canonical.head.output.bias.data[0] = -1e4


@pytest.mark.parametrize("change", [to_nan, explode, empty], ids=lambda f: f.__name__)
def test_a_spoilt_run_is_brought_back_and_ends_well(frames, change):
    renderer, made = small_renderer(), trainer()
    callback, steps = break_once(30, change)
    record = made.fit(renderer, frames, callbacks=[callback])
    (failure,) = made.recovery.failures
    # The first record after a NaN, the third after a collapse.
    assert failure.step == (45 if change is empty else 35)
    assert failure.step not in steps
    assert record.step == 60
    assert made.recovery.factor == pytest.approx(0.3)
    assert all(torch.isfinite(p).all() for p in renderer.parameters())
    assert record.psnr > 8
    assert renderer.render_image(frames.camera(0), 0.0).opacity.max() > 0.1


def test_learning_rate_spikes_end_with_an_error_that_says_what_to_do(frames):
    made = trainer(learning_rates={"": 1e30})
    with pytest.raises(FloatingPointError, match=r"step \d+: .*not finite.*lower its learning rate.*rollbacks"):
        made.fit(small_renderer(), frames)


def test_a_healthy_run_is_the_same_with_and_without_a_watch(frames):
    plain, watched = small_renderer(), small_renderer()
    trainer(num_steps=12, recovery=None).fit(plain, frames)
    trainer(num_steps=12).fit(watched, frames)
    for a, b in zip(plain.parameters(), watched.parameters(), strict=True):
        assert torch.equal(a, b)


def test_pictures_of_nothing_are_learnt_without_complaint(frames):
    nothing = copy.copy(frames)
    object.__setattr__(nothing, "images", torch.zeros_like(frames.images))
    renderer, made = small_renderer(occupancy=True), trainer(num_steps=60)
    record = made.fit(renderer, nothing)
    assert not made.recovery.failures
    assert math.isfinite(record.losses["loss"])
    assert record.losses["loss"] < 0.1
    assert all(torch.isfinite(p).all() for p in renderer.parameters())


def test_bfloat16_autocast_trains_like_float32(frames):
    losses = {}
    for precision in ("float32", "bfloat16"):
        seen: list[float] = []
        note = lambda record, _, seen=seen: seen.append(record.losses["loss"])  # noqa: E731
        trainer(num_steps=40, recovery=None).fit(small_renderer(precision), frames, callbacks=[note])
        losses[precision] = torch.tensor(seen)
    # The same rays and points: losses differ by the networks' rounding (4e-3 a product) and what training makes of it.
    assert ((losses["bfloat16"] - losses["float32"]).abs() / losses["float32"]).max() < 0.1


@pytest.mark.parametrize(
    "name",
    [
        "thin_rod",
        "fast_ball",
        "opaque_wall",
        "merging_balls",
        "vanishing_ball",
        "jumping_ball",
        "twisting_block",
        "bouncing_balls",
        "snowman",
    ],
)
def test_hard_scenes_are_trained_on_without_failure(name):
    renderer, made = small_renderer("bfloat16", occupancy=True), trainer(num_steps=20)
    made.fit(renderer, frames_of(name))
    assert not made.recovery.failures
    assert all(torch.isfinite(p).all() for p in renderer.parameters())
