"""What a GPU replays is what would have been done: trainings and images, replayed on the CPU, agree bit for bit."""

import math
from collections.abc import Callable
from itertools import pairwise

import pytest
import torch
from fixed_models import BOX, losses, small_renderer
from recorded_graphs import RecordedCache, recorded_graphs
from torch import Tensor, nn

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.data import Frames, SyntheticData
from dnerf.data.pixel_samplers import ErrorGuidedPixels, TemporalCurriculum
from dnerf.deformations import DisplacementDeformation, FlowChain, FlowDeformation
from dnerf.deformations.velocities import NetworkVelocity
from dnerf.rendering.renderer import Renderer
from dnerf.scenes import make_scene
from dnerf.training.optimizer import AdamSettings
from dnerf.training.records import TrainingRecord
from dnerf.training.recovery import Recovery
from dnerf.training.run import Callback, Run
from dnerf.training.trainer import Trainer


@pytest.fixture(scope="module")
def frames() -> Frames:
    return SyntheticData(make_scene("walker"), 16, num_train=6).frames("train")


class Records(Callback):
    """Collects records of steps."""

    def __init__(self) -> None:
        self.found: list[TrainingRecord] = []

    def on_step_end(self, run: Run) -> None:
        if run.record is not None:
            self.found.append(run.record)


class Spoil(Callback):
    """Breaks a parameter, once."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_step_begin(self, run: Run) -> None:
        if run.step == self.step:
            self.step = -1
            next(run.renderer.field.parameters()).data.fill_(math.nan)


def trained(
    frames: Frames, renderer: Renderer, *, replays: bool, num_steps: int = 48, **settings: object
) -> tuple[dict[str, Tensor], list[TrainingRecord], type[RecordedCache]]:
    """What a renderer's tensors are after training, its records, and what was replayed."""
    records = Records()
    trainer = Trainer(
        num_steps=num_steps, num_rays=256, target_samples=4096, graphs=True, losses=losses(), log_every=4,
        optimizer=AdamSettings({"default": 1e-2}, warmup_steps=4, orthogonal=True),
        pixels=ErrorGuidedPixels(TemporalCurriculum(end=0.3, start=0.2), resolution=4),
        callbacks={**settings.pop("callbacks", {}), "records": records}, **settings,
    )  # fmt: skip
    with recorded_graphs(replays=replays) as cache:
        trainer.fit(renderer, frames)
    return {name: x.clone() for name, x in renderer.state_dict().items()}, records.found, cache


def assert_the_same(
    frames: Frames, make: Callable[[], Renderer], callbacks: Callable[[], dict[str, Callback]] = dict,
    **settings: object,
) -> None:  # fmt: skip
    plain, before, _ = trained(frames, make(), replays=False, callbacks=callbacks(), **settings)
    replayed, after, cache = trained(frames, make(), replays=True, callbacks=callbacks(), **settings)
    assert cache.replays > cache.recordings > 0
    assert [vars(a) | {"seconds": 0} for a in after] == [vars(b) | {"seconds": 0} for b in before]
    assert [name for name in plain if not torch.equal(plain[name], replayed[name])] == []


def test_trainings_are_replayed(frames: Frames) -> None:
    assert_the_same(frames, small_renderer)


def test_a_training_that_is_brought_back_is_recorded_anew(frames: Frames) -> None:
    assert_the_same(frames, small_renderer, lambda: {"spoil": Spoil(28), "recovery": Recovery(keep_every=8)})


def test_flows_are_replayed(frames: Frames) -> None:
    def make() -> Renderer:
        renderer = small_renderer()
        options = {"velocity_in_time": "stationary", "solver": "euler", "num_steps": 1}
        flows = {name: FlowDeformation(NetworkVelocity(BOX, 2, 16), None, **options) for name in ("first", "second")}
        renderer.field.deformation = FlowChain(flows)
        return renderer

    assert_the_same(frames, make, num_steps=32)


def test_images_follow_the_model() -> None:
    """Tensors that change where they lie, another way to place samples, and parts that are exchanged."""
    renderer = small_renderer(graphs=True, render_dilation=0).eval()
    field, sampler = renderer.field, renderer.sampler
    sampler.grid.maxima.fill_(1.0)
    sampler.grid.decide()
    with torch.no_grad():
        field.canonical.table.mul_(3000)

    def exchange() -> None:
        field.deformation = DisplacementDeformation(2, 32, (), canonical_time=None)
        torch.nn.init.normal_(field.deformation.mlp.output.weight, std=0.3)
        renderer.invalidate()

    changes = (
        lambda: None, lambda: field.canonical.table.data.mul_(-1), lambda: setattr(sampler, "render_subdivision", 1),
        exchange,
    )  # fmt: skip
    camera = Camera(Intrinsics(20, 16, 25.0, 25.0), look_at((3.5, 0.3, 1.0)))
    found = []
    with recorded_graphs() as cache:
        for change in changes:
            change()
            before = cache.replays
            images = [renderer.render_image(camera, 0.4).rgb for _ in range(3)]
            assert cache.replays > before
            with recorded_graphs(replays=False):
                renderer._frames, kept = None, renderer._frames
                expected = renderer.render_image(camera, 0.4).rgb
                renderer._frames = kept
            for image in images:
                torch.testing.assert_close(image, expected, rtol=0, atol=1e-6)
            found.append(expected)
    for a, b in pairwise(found):
        assert float((a - b).abs().max()) > 1e-3


def test_what_is_not_replayable_shows() -> None:
    """The harness notices a number of the host that changes, and a value that is read."""

    class Counting(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.count = 0

        def forward(self, x: Tensor) -> Tensor:
            self.count += 1
            return x * self.count

    counting = Counting()
    cache = RecordedCache(torch.device("cpu"))
    one = torch.ones(1)
    found = [float(cache.run("counts", 0, lambda x: {"y": counting(x)}, one)["y"]) for _ in range(4)]
    assert found == [1.0, 2.0, 2.0, 2.0]
    cache.run("reads", 0, lambda x: {"y": x * float(x)}, one)
    with pytest.raises(AssertionError, match="_local_scalar_dense"):
        cache.run("reads", 0, lambda x: {"y": x * float(x)}, one)
