"""The training loop: spikes, not-a-numbers, collapse, empty images, bfloat16, hard scenes."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from reference import occupancy_sampler

from dnerf.core.backgrounds import RandomBackground
from dnerf.data import Frames, render_frames
from dnerf.data.synthetic import random_views
from dnerf.deformations import DisplacementDeformation
from dnerf.fields import DeformedField, GridField
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.training.optimizer import AdamSettings
from dnerf.training.records import TrainingRecord
from dnerf.training.recovery import Recovery
from dnerf.training.run import Callback, Run
from dnerf.training.trainer import Trainer

BOX = [[-1.5] * 3, [1.5] * 3]


def frames_of(name: str, resolution: int = 16, count: int = 4) -> Frames:
    return render_frames(make_scene(name), *random_views(count), resolution)


def small_renderer(precision: str = "float32", occupancy: bool = False) -> Renderer:
    torch.manual_seed(0)
    deformation = DisplacementDeformation(2, 16, (), position_frequencies=2, time_frequencies=3)
    field = DeformedField(deformation, GridField(BOX, (8, 16), 8, hidden_features=16, num_layers=1))
    sampler = occupancy_sampler(BOX, 0.1, 16, num_slabs=4) if occupancy else StratifiedSampler(24, BOX)
    return Renderer(field, sampler, RandomBackground(), precision=precision)


class Watch(Callback):
    """Keeps the records that stand, and changes the model once."""

    def __init__(self, at: int = -1, change: Callable[[Renderer], None] | None = None) -> None:
        self.at = at
        self.change = change
        self.records: list[TrainingRecord] = []

    def on_step_end(self, run: Run) -> None:
        if run.record is not None:
            self.records.append(run.record)
        if run.step == self.at:
            self.change(run.renderer)


def train(
    renderer: Renderer, frames: Frames, *, num_steps: int = 60, watch: Watch | None = None,
    recovery: Recovery | None = None, rates: dict[str, float] | None = None,
) -> TrainingRecord:  # fmt: skip
    trainer = Trainer(
        num_steps=num_steps, num_rays=64, log_every=5,
        optimizer=AdamSettings(rates or {"default": 1e-2, "deformation": 1e-3, "deformation_output": 1e-3}),
        callbacks={"recovery": recovery, "watch": watch},
    )  # fmt: skip
    return trainer.fit(renderer, frames)


def watchful() -> Recovery:
    return Recovery(keep_every=5, patience=3)


@pytest.fixture(scope="module")
def frames() -> Frames:
    return frames_of("static")


def to_nan(renderer: Renderer) -> None:
    renderer.field.deformation.mlp.output.weight.data[0, 0] = math.nan


def explode(renderer: Renderer) -> None:
    for parameter in renderer.parameters():
        parameter.data.mul_(1e25)


def empty(renderer: Renderer) -> None:
    renderer.field.canonical.head.output.weight.data.zero_()
    renderer.field.canonical.head.output.bias.data[0] = -1e4


@pytest.mark.parametrize("change", [to_nan, explode, empty], ids=lambda f: f.__name__)
def test_a_spoilt_run_is_brought_back_and_ends_well(frames: Frames, change: Callable[[Renderer], None]) -> None:
    renderer, recovery, watch = small_renderer(), watchful(), Watch(30, change)
    record = train(renderer, frames, watch=watch, recovery=recovery)
    (failure,) = recovery.failures
    # The first record after a NaN, the third after a collapse.
    step = 45 if change is empty else 35
    assert failure.startswith(f"step {step}: ")
    assert step not in [record.step for record in watch.records]
    assert record.step == 60
    assert recovery.rollbacks == 1
    assert all(torch.isfinite(p).all() for p in renderer.parameters())
    assert record.psnr > 8
    assert renderer.render_image(frames.camera(0), 0.0).opacity.max() > 0.1


def test_learning_rate_spikes_end_with_an_error_that_says_what_to_do(frames: Frames) -> None:
    with pytest.raises(FloatingPointError, match=r"step \d+: .*not finite.*lower its learning rate.*rollbacks"):
        train(small_renderer(), frames, recovery=watchful(), rates={"default": 1e30})


def test_a_healthy_run_is_the_same_with_and_without_a_watch(frames: Frames) -> None:
    plain, watched = small_renderer(), small_renderer()
    train(plain, frames, num_steps=12)
    train(watched, frames, num_steps=12, recovery=watchful())
    for a, b in zip(plain.parameters(), watched.parameters(), strict=True):
        assert torch.equal(a, b)


def test_images_of_nothing_are_learnt_without_complaint(frames: Frames) -> None:
    nothing = replace(frames, images=torch.zeros_like(frames.images))
    renderer, recovery = small_renderer(occupancy=True), watchful()
    record = train(renderer, nothing, recovery=recovery)
    assert not recovery.failures
    assert math.isfinite(record.losses["loss"])
    assert record.losses["loss"] < 0.1
    assert all(torch.isfinite(p).all() for p in renderer.parameters())


def test_bfloat16_autocast_trains_like_float32(frames: Frames) -> None:
    losses = {}
    for precision in ("float32", "bfloat16"):
        watch = Watch()
        train(small_renderer(precision), frames, num_steps=40, watch=watch)
        losses[precision] = torch.tensor([record.losses["loss"] for record in watch.records])
    # The same rays and points: losses differ by the networks' rounding (4e-3 a product) and what training makes of it.
    assert ((losses["bfloat16"] - losses["float32"]).abs() / losses["float32"]).max() < 0.1


@pytest.mark.parametrize("name", [
    "thin_rod", "opaque_wall", "merging_balls", "vanishing_ball", "jumping_ball", "twisting_block",
    "bouncing_balls", "snowman",
])  # fmt: skip
def test_hard_scenes_are_trained_on_without_failure(name: str) -> None:
    renderer, recovery = small_renderer("bfloat16", occupancy=True), watchful()
    train(renderer, frames_of(name), num_steps=20, recovery=recovery)
    assert not recovery.failures
    assert all(torch.isfinite(p).all() for p in renderer.parameters())
