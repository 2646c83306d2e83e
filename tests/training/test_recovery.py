"""Watching a run: what is kept, what is noticed, what comes back, and when it is enough."""

import math

import pytest
import torch
from small_runs import run_of, small_renderer
from torch import Tensor

from dnerf.training import Recovery, Run, TrainingRecord


class Watched:
    """A run in the middle, and the callback that watches it."""

    def __init__(self, **settings: float) -> None:
        self.recovery = Recovery(**settings)
        self.run: Run = run_of(small_renderer(), callbacks={"recovery": self.recovery})
        self.bias = self.run.renderer.field.canonical.head.output.bias
        self.recovery.on_train_begin(self.run)

    def turn(self, step: int, loss: float = 1.0, opacity: float = 0.5, contrast: float = 0.3) -> bool:
        """Take a step and show its record; whether that stands."""
        self.run.step = step
        self.recovery.on_step_begin(self.run)
        for parameter in self.run.renderer.parameters():
            parameter.grad = torch.ones_like(parameter)
        self.run.optimizer.step()
        self.run.set_record(TrainingRecord(step, 1.0, {"loss": loss}, 9.0, 64, 100, 1.0, opacity, contrast))
        self.recovery.on_step_end(self.run)
        return self.run.record is not None

    def state(self) -> list[Tensor]:
        moments = [v for s in self.run.optimizer.state_dict()["state"].values() for v in s.values()]
        return [x.clone() for x in [*self.run.renderer.state_dict().values(), *moments]]


def test_weights_buffers_and_moments_come_back(caplog: pytest.LogCaptureFixture) -> None:
    watched = Watched(keep_every=10)
    assert watched.turn(1)
    kept = watched.state()
    assert watched.turn(2)
    stands = watched.run.last_record
    watched.run.renderer.sampler.grid.maxima.add_(1)
    assert not torch.equal(watched.state()[0], kept[0])
    for step, rate in ((7, 0.3), (8, 0.09)):  # what came back is a copy: going wrong again does not spoil it
        generation = watched.run.renderer.generation
        watched.bias.data[2] = math.nan
        assert not watched.turn(step, loss=math.nan)
        assert all(torch.equal(a, b) for a, b in zip(watched.state(), kept, strict=True))
        assert watched.run.last_record is stands
        assert watched.run.renderer.generation == generation + 1  # no graph replays what was
        watched.recovery.on_step_begin(watched.run)
        assert watched.run.rate_factor == pytest.approx(rate)
    failure = watched.recovery.failures[0]
    assert failure.startswith("step 7: losses not finite: loss, parameters not finite: field.canonical.head.output")
    assert "a step that was too large, first seen in field.canonical.head.output.bias" in failure
    assert "back to the state of step 1, learning rates now 0.3 of the schedule's (rollback 1 of 3)" in caplog.text


def test_gradients_are_noticed_before_they_spoil_the_weights() -> None:
    watched = Watched()
    watched.turn(1)
    watched.bias.grad[0] = math.inf
    watched.run.set_record(watched.run.record)
    watched.recovery.on_step_end(watched.run)
    (failure,) = watched.recovery.failures
    assert failure.startswith(
        "step 1: gradients not finite: field.canonical.head.output.bias; likely cause: a gradient"
    )
    assert "a gradient that overflows, first seen in field.canonical.head.output.bias" in failure


def test_states_are_kept_every_so_often() -> None:
    watched, kept = Watched(keep_every=10), {}
    for step in (1, 5, 11, 15, 20):
        watched.turn(step)
        kept[step] = watched.bias.detach().clone()
    assert not watched.turn(21, loss=math.nan)
    assert torch.equal(watched.bias, kept[11])


def test_a_run_that_keeps_breaking_ends_with_what_happened() -> None:
    watched = Watched(max_rollbacks=2)
    assert [watched.turn(step, loss) for step, loss in ((1, 1.0), (2, math.nan), (3, math.inf))] == [True, False, False]
    with pytest.raises(FloatingPointError, match=r"step 4: losses not finite: loss; likely cause: .*; 2 rollbacks"):
        watched.turn(4, math.nan)


@pytest.mark.parametrize("max_rollbacks", [0, 3])
def test_without_a_good_state_or_a_rollback_left_the_run_ends_at_once(max_rollbacks: int) -> None:
    watched = Watched(max_rollbacks=max_rollbacks)
    if not max_rollbacks:
        watched.turn(1)
    with pytest.raises(FloatingPointError, match="step 2"):
        watched.turn(2, math.nan)


def test_nothing_but_background_for_a_while_is_a_collapse() -> None:
    watched = Watched(patience=3, keep_every=1)
    watched.turn(1, opacity=0.4)
    good = watched.bias.detach().clone()
    assert [watched.turn(step, opacity=1e-5) for step in (2, 3, 4)] == [True, True, False]
    said = "all background in 3 records in a row (mean opacity 1.0e-05, while they should differ from it by 0.30)"
    assert said in watched.recovery.failures[0]
    assert torch.equal(watched.bias, good)  # not one of the states after the collapse began


def test_an_empty_image_of_an_empty_scene_is_no_collapse() -> None:
    watched = Watched(patience=2)
    assert all(watched.turn(step, opacity=1e-5, contrast=0.001) for step in range(1, 9))


def test_a_new_run_knows_nothing_of_the_last_and_a_continued_one_goes_on_counting() -> None:
    watched = Watched(max_rollbacks=2)
    watched.turn(1)
    watched.turn(2, math.nan)
    state = watched.recovery.state_dict()
    watched.recovery.on_train_begin(watched.run)
    assert watched.recovery.rollbacks == 0
    with pytest.raises(FloatingPointError, match="0 rollbacks"):
        watched.turn(1, math.nan)
    watched.recovery.load_state_dict(state)
    watched.turn(3)
    assert watched.run.rate_factor == pytest.approx(0.3)
    watched.turn(4, math.nan)
    with pytest.raises(FloatingPointError, match="2 rollbacks"):
        watched.turn(5, math.nan)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_rollbacks": -1}, "max_rollbacks must be >= 0"),
        ({"learning_rate_factor": 1.0}, r"learning_rate_factor must be in \(0, 1\), got 1.0"),
        ({"keep_every": 0}, "keep_every must be > 0"),
        ({"patience": 0}, "patience must be > 0"),
    ],
)
def test_numbers_out_of_range_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Recovery(**options)
