"""The running mean of weights against its closed form."""

import math

import pytest
import torch
from small_runs import run_of, small_renderer

from dnerf.training import Run, WeightAverage


def begun(average: WeightAverage) -> Run:
    """A run before its first step."""
    run = run_of(small_renderer(), step=0, callbacks={"average": average})
    average.on_train_begin(run)
    return run


def bias(run: Run) -> torch.Tensor:
    return run.renderer.field.canonical.head.output.bias.data


def step(run: Run, average: WeightAverage, value: float) -> None:
    run.step += 1
    bias(run).fill_(value)
    average.on_step_end(run)


@pytest.mark.parametrize("span", [0.05, 0.5])
def test_weights_end_as_their_mean_over_a_share_of_the_steps(span: float) -> None:
    """Step s of S counts (s / S)^(1 / span) less what its forerunner does."""
    average = WeightAverage(span, every=1)
    run, values = begun(average), torch.rand(50)
    generation = run.renderer.generation
    for value in values:
        step(run, average, float(value))
    average.on_train_end(run)
    reached = (torch.arange(51) / 50) ** (1 / span)
    torch.testing.assert_close(bias(run), (reached.diff() * values).sum().expand(4))
    assert run.renderer.generation > generation  # no graph replays what was


def test_steps_between_looks_count_as_the_next_one() -> None:
    average = WeightAverage(0.5, every=4)
    run = begun(average)
    for number in range(1, 8):
        run.ends = number == 7
        step(run, average, float(number))
    average.on_train_end(run)
    torch.testing.assert_close(bias(run), torch.full((4,), 4.0 * (4 / 7) ** 2 + 7.0 * (1 - (4 / 7) ** 2)))


def test_averaging_begins_anew_after_a_rollback() -> None:
    average = WeightAverage(every=1)
    run = begun(average)
    step(run, average, math.nan)
    run.renderer.invalidate()
    step(run, average, 2.0)
    average.on_train_end(run)
    assert bias(run).tolist() == [2.0] * 4


def test_a_continued_average_is_the_same() -> None:
    ends = []
    for stops in (False, True):
        average = WeightAverage(0.5, every=1)
        run = begun(average)
        for number, value in enumerate((1.0, 5.0, 2.0, 4.0)):
            step(run, average, value)
            if stops and number == 1:
                state = {name: x.clone() for name, x in average.state_dict().items()}
                average = WeightAverage(0.5, every=1)
                average.on_train_begin(run)
                average.load_state_dict(state)
        average.on_train_end(run)
        ends.append(bias(run).clone())
    assert torch.equal(*ends)


@pytest.mark.parametrize("settings", [{"span": 0.0}, {"every": 0}])
def test_numbers_out_of_range_are_named(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        WeightAverage(**settings)
