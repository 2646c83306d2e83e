"""What a GPU replays is what would have been done: trainings and pictures, replayed on the CPU, agree bit for bit."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import pytest
import torch
from fixed_models import BOX, losses, small_renderer
from recorded_graphs import RecordedCache, recorded_graphs
from torch import Tensor, nn

from dnerf.body_search import BodySearch
from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.data import Frames, SyntheticData
from dnerf.deformations import CarriedBodies, FlowChain, FlowDeformation
from dnerf.deformations.velocities import NetworkVelocity
from dnerf.error_map import ErrorMap
from dnerf.fields import DeformedField, SpaceTimeVolumes
from dnerf.missing_matter import MissingMatterCheck
from dnerf.records import Callback, TrainingRecord
from dnerf.recovery import Recovery
from dnerf.renderer import Renderer
from dnerf.scenes import make_scene
from dnerf.time_window import TimeWindow
from dnerf.training import Trainer


@pytest.fixture(scope="module")
def frames() -> Frames:
    return SyntheticData(make_scene("walker"), 16, num_train=6).frames("train")


def field_of(renderer: Renderer) -> DeformedField:
    assert isinstance(renderer.field, DeformedField)
    return renderer.field


def carry_one(renderer: Renderer) -> None:
    bodies = field_of(renderer).bodies
    assert bodies is not None
    bodies.add(torch.linspace(-1, 0.5, 5)[:, None].expand(5, 3).clone(), torch.tensor([1.1, 1.1, -1.1]), 0.4)


class OneBody(BodySearch):
    """Finds the same body in all pictures."""

    def __call__(self, step: int, renderer: Renderer, frames: Frames, error_map: ErrorMap) -> bool:
        carry_one(renderer)
        bodies = field_of(renderer).bodies
        assert bodies is not None
        bodies.set_searched()
        return True


def trained(
    frames: Frames,
    renderer: Renderer,
    *,
    replays: bool,
    callbacks: Sequence[Callback] = (),
    num_steps: int = 48,
    **settings: object,
) -> tuple[dict[str, Tensor], list[TrainingRecord], type[RecordedCache]]:
    """What a renderer's tensors are after training, its records, and what was replayed."""
    records: list[TrainingRecord] = []
    trainer = Trainer(
        num_steps=num_steps, num_rays=256, target_samples=4096, graphs=True, learning_rates={"": 1e-2},
        orthogonal=["field.deformation"], losses=losses(), warmup_steps=4,
        loss_every={"elastic": 2, "steady": 4, "hidden_matter": 4}, progress_bar=False, log_every=4, **settings,
    )  # fmt: skip
    with recorded_graphs(replays=replays) as cache:
        trainer.fit(renderer, frames, callbacks=[lambda record, _: records.append(record), *callbacks])
    return {name: x.clone() for name, x in renderer.state_dict().items()}, records, cache


def assert_the_same(frames: Frames, make: Callable[[], Renderer], settings: Callable[[], dict[str, object]]) -> None:
    plain, before, _ = trained(frames, make(), replays=False, **settings())  # type: ignore[arg-type]
    replayed, after, cache = trained(frames, make(), replays=True, **settings())  # type: ignore[arg-type]
    assert cache.replays > cache.recordings > 0
    assert [vars(a) | {"seconds": 0} for a in after] == [vars(b) | {"seconds": 0} for b in before]
    different = [name for name in plain if not torch.equal(plain[name], replayed[name])]
    assert different == []


def test_trainings_in_which_volumes_join_and_a_body_is_carried_are_replayed(frames: Frames) -> None:
    def make() -> Renderer:
        renderer = small_renderer()
        field_of(renderer).bodies = CarriedBodies(2, 5)
        field_of(renderer).canonical.space_time = SpaceTimeVolumes(BOX, (8,), (4,), waits=True)  # type: ignore[union-attr]
        return renderer

    def settings() -> dict[str, object]:
        return {
            "error_map": ErrorMap(resolution=4),
            "time_window": TimeWindow(0.5, end=0.2, start=0.3),
            "missing_matter": MissingMatterCheck(1e-6, begin=0.3, every=1, min_steps=4),
            "body_search": OneBody(BOX, 0.6, min_steps=4),
        }

    renderer = make()
    trained(frames, renderer, replays=True, **settings())  # type: ignore[arg-type]
    bodies, volumes = field_of(renderer).bodies, field_of(renderer).canonical.space_time  # type: ignore[union-attr]
    assert isinstance(bodies, CarriedBodies)
    assert isinstance(volumes, SpaceTimeVolumes)
    assert bodies.num_bodies == 1
    assert float(bodies.tracks.grad.abs().max()) > 0  # type: ignore[union-attr]
    assert volumes.has_joined
    assert_the_same(frames, make, settings)


def test_a_training_that_is_brought_back_is_recorded_anew(frames: Frames) -> None:
    def settings() -> dict[str, object]:
        broken: list[int] = []

        def spoil(record: TrainingRecord, renderer: Renderer) -> None:
            if record.step == 28 and not broken:
                broken.append(record.step)
                next(renderer.field.parameters()).data.fill_(math.nan)

        return {"recovery": Recovery(keep_every=8), "callbacks": [spoil]}

    assert_the_same(frames, small_renderer, settings)


def test_flows_are_replayed(frames: Frames) -> None:
    def make() -> Renderer:
        renderer = small_renderer()
        flows = {
            name: FlowDeformation(
                NetworkVelocity(BOX, 2, 16, twists=0.3), None, clock="frozen", solver="euler", num_steps=1
            )
            for name in ("first", "second")
        }
        field_of(renderer).deformation = FlowChain(flows)
        return renderer

    assert_the_same(frames, make, lambda: {"num_steps": 32})


def test_pictures_follow_what_joins_and_what_is_carried() -> None:
    """A picture that was recorded before is of a model that is no more."""
    renderer = small_renderer(graphs=True, render_margin=0).eval()
    field = field_of(renderer)
    field.bodies = CarriedBodies(2, 5)
    volumes = SpaceTimeVolumes(BOX, (8,), (4,), waits=True)
    field.canonical.space_time = volumes  # type: ignore[union-attr]
    renderer.sampler.maxima.fill_(1.0)  # type: ignore[union-attr,operator]
    renderer.sampler.decide()  # type: ignore[operator]
    with torch.no_grad():
        field.canonical.table.mul_(3000)  # type: ignore[union-attr,operator]
        for table in volumes.tables:
            table.mul_(100)
    camera = Camera(Intrinsics(20, 16, 25.0, 25.0), look_at((3.5, 0.3, 1.0)))
    seen = []
    for change in (lambda: None, volumes.join, lambda: carry_one(renderer)):
        change()
        with recorded_graphs() as cache:
            pictures = [renderer.render_image(camera, 0.4).rgb for _ in range(3)]
        assert cache.replays > 0
        with recorded_graphs(replays=False):
            expected = renderer.render_image(camera, 0.4).rgb
        for picture in pictures:
            torch.testing.assert_close(picture, expected, rtol=0, atol=1e-6)
        seen.append(expected)
    for a, b in pairwise(seen):
        assert float((a - b).abs().max()) > 0.02


def test_what_is_not_replayable_shows() -> None:
    """The harness notices a number of the host that changes, and a value that is asked for."""

    class Counting(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.asked = 0

        def forward(self, x: Tensor) -> Tensor:
            self.asked += 1
            return x * self.asked

    counting = Counting()
    cache = RecordedCache(torch.device("cpu"))
    one = torch.ones(1)
    found = [float(cache.run("counts", 0, lambda x: {"y": counting(x)}, one)["y"]) for _ in range(4)]
    assert found == [1.0, 2.0, 2.0, 2.0]
    cache.run("asks", 0, lambda x: {"y": x * float(x)}, one)
    with pytest.raises(AssertionError, match="_local_scalar_dense"):
        cache.run("asks", 0, lambda x: {"y": x * float(x)}, one)
