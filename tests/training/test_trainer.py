"""Training as a whole: what ends it, what acts in it, what it needs, and what does not begin anew."""

import math
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partialmethod
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from small_runs import BOX, Watch, weights

from dnerf.core.backgrounds import ConstantBackground, RandomBackground
from dnerf.core.compositing import Rendering
from dnerf.core.schedules import Ramp
from dnerf.data import Frames, SyntheticData
from dnerf.data.normalization import Similarity
from dnerf.data.pixel_samplers import ErrorGuidedPixels, TemporalCurriculum, UniformPixels
from dnerf.data.scene_record import CameraSet, SceneRecord, World
from dnerf.deformations import DisplacementDeformation
from dnerf.fields import DeformedField, GridField, NeRFField, SurroundingsBackground
from dnerf.losses import Batch, ElasticLoss, Loss, PhotometricLoss, TimeEmbeddingLoss, UnseenSpaceLoss
from dnerf.rendering import Renderer
from dnerf.samplers import OccupancyGrid, OccupancySampler, StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.training import (
    AdamSettings,
    BoxWarning,
    Callback,
    Checkpoints,
    JsonLinesLog,
    ProgressBar,
    Recovery,
    Run,
    Trainer,
    TrainingStopped,
)
from dnerf.training.records import Limits


@pytest.fixture(scope="module")
def frames() -> Frames:
    return SyntheticData(make_scene("static"), 24, num_train=8).frames("train")


def small_renderer(background: Any = None, sampler: Any = None, deformed: bool = True, **deformation: Any) -> Renderer:
    torch.manual_seed(0)
    motion = DisplacementDeformation(2, 32, (), **{"position_frequencies": 4, "time_frequencies": 2, **deformation})
    field = NeRFField(2, 32, (), position_frequencies=4, density_shift=-1.0)
    return Renderer(
        DeformedField(motion, field) if deformed else field,
        StratifiedSampler(24, BOX) if sampler is None else sampler,
        RandomBackground() if background is None else background,
    )


def trainer(**changes: Any) -> Trainer:
    return Trainer(**{"num_steps": 20, "num_rays": 64, "log_every": 1, **changes})


Work = Callable[[Run], Any]


def watched(frames: Frames, work: Work = lambda run: None, **changes: Any) -> list[Any]:
    """The records of a training of a small model."""
    watch = Watch(work)
    trainer(callbacks={"watch": watch}, **changes).fit(small_renderer(), frames)
    return watch.records


def test_same_seed_gives_the_same_weights_with_a_trainer_that_was_used_before_too(frames: Frames) -> None:
    losses = {"rgb": PhotometricLoss(), "embedding": TimeEmbeddingLoss(10.0, rays_per_embedding=20, every=1)}
    made = trainer(losses=losses, pixels=ErrorGuidedPixels(TemporalCurriculum(), 0.5), callbacks={"back": Recovery()})
    one, two, other = (small_renderer(time_embeddings=8) for _ in range(3))
    for renderer, seed in ((one, 3), (two, 3), (other, 4)):
        made.fit(renderer, frames, seed=seed)
        assert not renderer.training
    assert torch.equal(weights(one), weights(two))
    assert not torch.equal(weights(one), weights(other))


def test_time_limit_ends_training_and_its_schedule(frames: Frames) -> None:
    record = trainer(num_steps=10**9, max_seconds=0.5).fit(small_renderer(), frames)
    assert 0.5 <= record.seconds < 5
    # The last step was taken just before the limit, so its factor is near the schedule's end, 0.1.
    assert record.learning_rate_factor < 0.3


def test_an_opening_has_so_many_steps_of_a_long_training_and_a_share_of_a_short_one() -> None:
    long, short = Limits(1000, None, 1, opening_steps=100), Limits(200, None, 1, opening_steps=100)
    assert [long.progress(step, 0.0) for step in (0, 50, 100, 550, 1000)] == pytest.approx([0, 0.15, 0.3, 0.65, 1])
    for step in (0, 20, 60, 130, 200):
        assert short.progress(step, 0.0) == pytest.approx(step / 200)
    timed = Limits(10**9, 100.0, 1, opening_steps=100)  # a step takes 0.1 s, from the 400th on 0.2 s
    seconds = [0.1 * step + 0.1 * max(0, step - 400) for step in range(701)]
    progress = [timed.progress(step, at) for step, at in enumerate(seconds)]
    assert [progress[0], progress[50], progress[100], progress[700]] == pytest.approx([0, 0.15, 0.3, 1])
    assert min(later - sooner for sooner, later in pairwise(progress)) > 0


def test_records_come_every_so_many_steps_and_at_the_end_and_callbacks_take_no_time(frames: Frames) -> None:
    records = watched(frames, lambda run: time.sleep(0.2), num_steps=13, log_every=5)
    assert [record.step for record in records] == [1, 5, 10, 13]
    assert records[-1].seconds < 1.5  # 2.6 s asleep


def test_rays_are_drawn_where_images_are_wrong_and_frames_come_in(frames: Frames) -> None:
    class Watched(ErrorGuidedPixels):
        def feedback(self, indices: torch.Tensor, errors: torch.Tensor) -> None:
            drawn.append((self.errors.clone(), indices))
            super().feedback(indices, errors)

    drawn: list[tuple[torch.Tensor, torch.Tensor]] = []
    watched(frames, num_steps=40, num_rays=512, pixels=Watched(TemporalCurriculum(0.5, 0.1), 0.5, resolution=8))
    size = frames.num_pixels // len(frames)
    nums_frames = [len({*(indices // size).tolist()}) for _, indices in drawn]
    assert nums_frames == sorted(nums_frames)
    assert nums_frames[0] < nums_frames[20] == nums_frames[-1] == len(frames)
    known, indices = drawn[-1]
    wrong = known[indices // size, indices % size // 24 // 3, indices % 24 // 3]
    assert float(wrong[256:].mean()) > 1.5 * float(wrong[:256].mean())  # guided rays beside even ones
    assert bool((known < 1).all())


class Spy(Callback):
    def __init__(self, name: str, said: list[str], *, fails_in: str = "", is_required: bool = False) -> None:
        self.name, self.said, self.fails_in, self.is_required = name, said, fails_in, is_required

    def _note(self, event: str, run: Run) -> None:
        has_record = "" if run.record is None else " record"
        self.said.append(f"{self.name} {event} {run.step}{has_record}{'' if run.renderer.training else ' eval'}")
        if event == self.fails_in:
            raise OSError("disk full")

    on_train_begin = partialmethod(_note, "begins")
    on_step_begin = partialmethod(_note, "before")
    on_step_end = partialmethod(_note, "after")
    on_train_end = partialmethod(_note, "ends")


def test_callbacks_are_called_in_order_those_that_are_required_last(frames: Frames) -> None:
    said: list[str] = []
    callbacks = {"c": Spy("c", said, is_required=True), "b": Spy("b", said), "none": None, "a": Spy("a", said)}
    trainer(num_steps=2, log_every=5, callbacks=callbacks).fit(small_renderer(), frames)
    expected = ["begins 0", "before 0", "after 1 record", "before 1 record", "after 2 record", "ends 2 record eval"]
    assert said == [f"{name} {event}" for event in expected for name in "bac"]


@pytest.mark.parametrize("event", ["before", "after", "ends"])
def test_a_callback_that_cannot_write_costs_its_output_only_unless_it_is_required(
    frames: Frames, event: str, caplog: pytest.LogCaptureFixture
) -> None:
    said: list[str] = []
    callbacks = {"a": Spy("a", said, fails_in=event), "b": Spy("b", said)}
    assert trainer(num_steps=2, callbacks=callbacks).fit(small_renderer(), frames).step == 2
    assert "Spy failed: disk full" in caplog.text
    assert "b ends 2 record eval" in said
    with pytest.raises(OSError, match="disk full"):
        trainer(callbacks={"a": Spy("a", said, fails_in=event, is_required=True)}).fit(small_renderer(), frames)


def test_a_record_that_is_taken_back_is_not_seen_by_others(frames: Frames) -> None:
    back, seen = Watch(lambda run: run.take_back() if run.step in (3, 6) else None), Watch()
    record = trainer(num_steps=6, callbacks={"back": back, "seen": seen}).fit(small_renderer(), frames)
    assert [record.step for record in seen.records] == [1, 2, 4, 5]
    assert record.step == 5


def test_deformations_learn_of_half_as_many_times_as_there_are_frames_and_keep_what_they_learnt(frames: Frames) -> None:
    renderer = small_renderer(time_embeddings=100)
    encoding = renderer.field.deformation.encode_times
    trainer(num_steps=1).fit(renderer, frames)
    assert int(encoding.num_used) == 4
    with torch.no_grad():
        encoding.embeddings[:4] = torch.arange(1.0, 5)[:, None]
    still = trainer(num_steps=1, optimizer=AdamSettings({"default": 0.0}))
    still.fit(renderer, frames.subset([0, 5]))  # fewer
    assert int(encoding.num_used) == 4
    still.fit(renderer, SyntheticData(make_scene("static"), 8, num_train=14).frames("train"))  # more
    assert encoding.embeddings[:7, 0].tolist() == pytest.approx([1, 1.5, 2, 2.5, 3, 3.5, 4])


class Shine(Loss):
    """Mean opacity."""

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> torch.Tensor:
        return rendering.opacity.mean()


def test_losses_add_up_with_their_weights_each_in_its_turn(frames: Frames) -> None:
    losses = {"rgb": PhotometricLoss(weight=Ramp(1.0, 2.0)), "shine": Shine(0.1, every=3), "none": None}
    records = watched(frames, num_steps=6, losses=losses)
    assert [record.step for record in records if "shine" in record.losses] == [3, 6]
    for record in records:
        terms = record.losses
        assert terms.keys() <= {"loss", "rgb", "shine"}
        expected = (1 + (record.step - 1) / 6) * terms["rgb"] + 3 * 0.1 * terms.get("shine", 0)
        assert math.isclose(terms["loss"], expected, rel_tol=1e-5)


def test_a_step_without_any_loss_changes_nothing(frames: Frames) -> None:
    seen: list[torch.Tensor] = []
    watched(frames, lambda run: seen.append(weights(run.renderer)), num_steps=2, losses={"shine": Shine(every=2)})
    assert torch.equal(seen[0], weights(small_renderer()))
    assert not torch.equal(seen[0], seen[1])


def test_broken_loss_is_reported_with_step_and_parameters(frames: Frames) -> None:
    renderer = small_renderer()
    with torch.no_grad():
        renderer.field.canonical.to_density.bias.fill_(math.nan)
    with pytest.raises(FloatingPointError, match=r"step 1: .*loss.*field\.canonical\.to_density\.bias"):
        trainer().fit(renderer, frames)


def test_what_has_opened_does_not_close_when_a_finished_run_is_continued_for_longer(tmp_path: Path) -> None:
    frames = SyntheticData(make_scene("walker"), 12, num_train=6).frames("train")

    def trained(num_steps: int) -> tuple[list[Any], list[tuple[float, int, list[float]]]]:
        torch.manual_seed(0)
        grid = GridField(BOX, (4, 8, 16), 2, hidden_features=8, window_end=0.9)
        renderer = Renderer(DeformedField(DisplacementDeformation(1, 8, ()), grid), StratifiedSampler(8, BOX))
        pixels = TemporalCurriculum(0.9, 0.2)
        levels: list[tuple[float, int, list[float]]] = []

        def look(run: Run) -> None:
            frames_in = pixels.frames_in(run.progress)
            levels.append((run.progress, 6 if frames_in is None else len(frames_in), grid.window.tolist()))

        watch = Watch(look)
        callbacks = {"watch": watch, "checkpoints": Checkpoints(None)}
        made = trainer(num_steps=num_steps, pixels=pixels, callbacks=callbacks, optimizer=AdamSettings(warmup_steps=3))
        made.fit(renderer, frames, folder=tmp_path, resume=True)
        return watch.records, levels

    (first, opened), (second, still_open) = trained(20), trained(100)
    assert (first[-1].step, second[0].step, second[-1].step) == (20, 21, 100)
    factors = [record.learning_rate_factor for record in (*first[3:], *second)]
    assert factors == sorted(factors, reverse=True)
    assert second[0].learning_rate_factor == first[-1].learning_rate_factor
    for before, after in pairwise(opened + still_open):
        assert all(a <= b for a, b in zip((*before[:2], *before[2]), (*after[:2], *after[2])))
    assert still_open[0][1:] == (6, [1.0, 1.0, 1.0])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_training_with_everything_saved(frames: Frames, tmp_path: Path, number: int) -> None:
    def trained(folder: str, work: Work = lambda run: None) -> tuple[Renderer, list[Any]]:
        watch, renderer = Watch(work), small_renderer()
        made = trainer(num_steps=8, log_every=5, callbacks={"watch": watch, "checkpoints": Checkpoints()})
        made.fit(renderer, frames, folder=tmp_path / folder, resume=True)
        return renderer, watch.records

    whole, before = trained("whole")[0], signal.getsignal(number)
    with pytest.raises(TrainingStopped, match=f"stopped by {number.name} after step 4, all saved") as stop:
        trained("parts", lambda run: os.kill(os.getpid(), number) if run.step == 3 else None)
    assert stop.value.exit_code == 128 + number
    assert [path.name for path in (tmp_path / "parts/checkpoints").iterdir()] == ["step_00000004.safetensors"]
    again, records = trained("parts")
    assert torch.equal(weights(again), weights(whole))
    assert [record.step for record in records] == [5, 8]
    assert signal.getsignal(number) is before


@pytest.mark.parametrize(
    ("renderer", "settings", "message"),
    [
        ({}, {"losses": {"unseen": UnseenSpaceLoss()}},
         "losses.unseen: UnseenSpaceLoss needs an occupancy-aware sampler, got StratifiedSampler; leave it out"),
        ({}, {"losses": {"smooth": TimeEmbeddingLoss()}},
         "losses.smooth: TimeEmbeddingLoss needs learnt time embeddings, this model has none; leave it out"),
        ({"deformed": False}, {"losses": {"elastic": ElasticLoss()}},
         "losses.elastic: ElasticLoss needs a deformed field, got NeRFField; leave it out"),
        ({}, {"callbacks": {"bar": ProgressBar()}},
         "resume=True needs a callback that continues runs, such as Checkpoints, got ProgressBar"),
        ({}, {"graphs": True, "target_samples": 9}, "graphs needs a sampler of fixed capacity, got StratifiedSampler"),
        ({}, {"callbacks": {"log": JsonLinesLog()}}, r"JsonLinesLog needs a folder, give fit\(folder=...\)"),
        ({}, {"callbacks": {"save": Checkpoints()}}, r"Checkpoints needs a folder, give fit\(folder=...\)"),
    ],
)  # fmt: skip
def test_a_part_that_lacks_what_it_needs_is_one_clear_error_before_the_first_step(
    frames: Frames, renderer: dict[str, Any], settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        trainer(**settings).fit(small_renderer(**renderer), frames, resume="resume" in message)


def test_a_random_background_needs_alpha() -> None:
    opaque = SyntheticData(make_scene("static"), 8, num_train=1, background="white").frames("train")
    with pytest.raises(ValueError, match=r"^background: .* needs frames with alpha"):
        trainer().fit(small_renderer(), opaque)
    trainer(num_steps=1).fit(small_renderer(ConstantBackground("white")), opaque)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        *(
            ({name: 0}, f"{name} must be > 0")
            for name in ("num_steps", "num_rays", "max_rays", "max_seconds", "opening_steps")
        ),
        *(({name: 0}, f"{name} must be > 0") for name in ("target_samples", "log_every", "marched_per_sample")),
        ({"num_rays": 100.5}, "num_rays must be a whole number, got 100.5"),
        ({"graphs": True}, "target_samples must be given with graphs, got null"),
        ({"losses": {"rgb": "mse"}}, "losses.rgb must be of Loss or null, got 'mse'"),
        ({"losses": [PhotometricLoss()]}, "losses must hold parts by name, got"),
        ({"callbacks": {"log": UniformPixels()}}, "callbacks.log must be of Callback or null, got"),
        ({"pixels": "guided"}, "trainer.pixels must be of PixelSampler or null, got 'guided'"),
        ({"optimizer": 1e-3}, "trainer.optimizer must be of AdamSettings or null, got 0.001"),
    ],
)
def test_other_numbers_and_parts_of_another_kind_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        trainer(**settings)


def test_a_bar_shows_progress_and_a_warning_says_where_the_box_is_left(
    frames: Frames, tmp_path: Path, capsys, caplog
) -> None:
    inside = ((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2))  # of what is modelled
    renderer = small_renderer(sampler=OccupancySampler(OccupancyGrid(inside, 8), 0.05))
    callbacks = {"bar": ProgressBar(), "box": BoxWarning(least_steps=20)}
    world = World(inside, Similarity(0.5, center=(1.0, 0.0, 0.0)))
    cameras = CameraSet(frames.poses, frames.times, frames.intrinsics)
    SceneRecord(world, {"train": cameras}).write(tmp_path)
    trainer(callbacks=callbacks).fit(renderer, frames, folder=tmp_path)
    assert "step 20, loss " in capsys.readouterr().err
    assert "geometry reaches the box at" in caplog.text
    assert "set data.box=[[0.48,-0.52,-0.52],[1.52,0.52,0.52]]" in caplog.text  # with room, in the data's own units


def test_nothing_is_said_of_the_box_where_the_background_shows_what_lies_beyond(frames: Frames, caplog) -> None:
    inside = ((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2))
    beyond = SurroundingsBackground(inside, GridField([[-2] * 3, [2] * 3], (4,), 2, hidden_features=8), 4)
    renderer = small_renderer(sampler=OccupancySampler(OccupancyGrid(inside, 8), 0.05), background=beyond)
    trainer(callbacks={"box": BoxWarning(least_steps=20)}).fit(renderer, frames)
    assert "geometry reaches the box" not in caplog.text


def test_nothing_is_learnt_from_pixels_that_do_not_count(frames: Frames) -> None:
    """Whatever they hold, the weights are the same; no block of them is drawn as unknown for ever."""
    known = torch.arange(frames.num_pixels) % 24 > 5
    found = []
    for value in (0, 200):
        images = frames.images.clone()
        images.view(-1, 4)[~known] = value
        model, pixels = small_renderer(), ErrorGuidedPixels(UniformPixels(), 0.5, resolution=12)
        trainer(pixels=pixels).fit(model, replace(frames, images=images, is_known=known))
        found.append(weights(model))
        ignored = pixels.errors[:, :, :3]  # never drawn, or known as right
        assert bool(((ignored == 1) | (ignored <= 1e-5)).all())
        assert bool((ignored <= 1e-5).any())
    assert torch.equal(*found)
