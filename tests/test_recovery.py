"""Watching a run: what is kept, what is noticed, what comes back, and when it is enough."""

import logging
import math

import pytest
import torch
from torch import nn

from dnerf.compositing import Rendering
from dnerf.recovery import Recovery, what_is_shown


class Run:
    """A linear model that takes Adam steps."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        self.model = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=0.1)

    def step(self) -> float:
        loss = self.model(torch.rand(8, 3)).square().sum()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return float(loss.detach())

    def state(self) -> list[torch.Tensor]:
        moments = [v for s in self.optimizer.state_dict()["state"].values() for v in s.values()]
        return [x.clone() for x in [*self.model.state_dict().values(), *moments]]


def batch(opacity: float, contrast: float) -> dict[str, float]:
    rays = torch.full((5,), opacity)
    background = torch.ones(5, 3)
    shown = what_is_shown(Rendering(background, rays, rays, background), background - contrast)
    return {name: float(value) for name, value in shown.items()}


def test_weights_buffers_and_moments_come_back(caplog):
    run, recovery = Run(), Recovery(keep_every=10)
    run.step()
    assert recovery.check(1, run.model, run.optimizer, {"loss": 1.0}) is None
    kept = run.state()
    for step in range(2, 6):
        run.step()
        assert recovery.check(step, run.model, run.optimizer, {"loss": 1.0}) is None
    assert not torch.equal(run.state()[0], kept[0])
    with torch.no_grad():
        run.model[0].weight[1, 2] = math.nan
    run.step()
    with caplog.at_level(logging.WARNING):
        failure = recovery.check(7, run.model, run.optimizer, {"loss": math.nan, "rgb": 1.0})
    for a, b in zip(run.state(), kept, strict=True):
        assert torch.equal(a, b)
    assert failure is not None
    assert "step 7: losses not finite: loss, parameters not finite: 0.weight" in str(failure)
    assert "a step that was too large, first seen in 0.weight" in str(failure)
    assert "back to the state of step 1, learning rates now 0.3 of the schedule's (rollback 1 of 3)" in caplog.text
    assert recovery.factor == 0.3
    # What came back is a copy: going wrong again does not spoil it.
    run.step()
    with torch.no_grad():
        run.model[0].bias.fill_(math.inf)
    recovery.check(8, run.model, run.optimizer, {"loss": 1.0})
    for a, b in zip(run.state(), kept, strict=True):
        assert torch.equal(a, b)
    assert recovery.factor == pytest.approx(0.09)


def test_gradients_are_noticed_before_they_spoil_the_weights():
    run, recovery = Run(), Recovery()
    run.step()
    recovery.check(1, run.model, run.optimizer, {"loss": 1.0})
    run.model[0].bias.grad[0] = math.inf
    failure = recovery.check(2, run.model, run.optimizer, {"loss": 1.0})
    assert "gradients not finite: 0.bias" in failure.what
    assert "a gradient that overflows, first seen in 0.bias" in failure.cause


def test_states_are_kept_every_so_often():
    run, recovery = Run(), Recovery(keep_every=10)
    kept = {}
    for step in (1, 5, 11, 15, 20):
        run.step()
        kept[step] = run.model[0].weight.detach().clone()
        recovery.check(step, run.model, run.optimizer, {"loss": 1.0})
    recovery.check(21, run.model, run.optimizer, {"loss": math.nan})
    assert torch.equal(run.model[0].weight, kept[11])


def test_a_run_that_keeps_breaking_ends_with_what_happened():
    run, recovery = Run(), Recovery(max_rollbacks=2)
    recovery.check(1, run.model, run.optimizer, {"loss": 1.0})
    assert recovery.check(2, run.model, run.optimizer, {"loss": math.nan})
    assert recovery.check(3, run.model, run.optimizer, {"loss": math.nan})
    with pytest.raises(FloatingPointError, match=r"step 4: losses not finite: loss; likely cause: .*; 2 rollbacks"):
        recovery.check(4, run.model, run.optimizer, {"loss": math.nan})


@pytest.mark.parametrize("max_rollbacks", [0, 3])
def test_without_a_good_state_or_a_rollback_left_the_run_ends_at_once(max_rollbacks):
    run, recovery = Run(), Recovery(max_rollbacks=max_rollbacks)
    if not max_rollbacks:
        recovery.check(1, run.model, run.optimizer, {"loss": 1.0})
    with pytest.raises(FloatingPointError, match="step 2"):
        recovery.check(2, run.model, run.optimizer, {"loss": math.nan})


def test_nothing_but_background_for_a_while_is_a_collapse():
    run, recovery = Run(), Recovery(patience=3, keep_every=1)
    recovery.check(1, run.model, run.optimizer, {"loss": 1.0}, batch(0.4, 0.3))
    good = run.model[0].weight.detach().clone()
    found = []
    for step in range(2, 5):
        run.step()
        found.append(recovery.check(step, run.model, run.optimizer, {"loss": 1.0}, batch(1e-5, 0.3)))
    assert found[:2] == [None, None]
    assert "all background in 3 records in a row (mean opacity 1.0e-05, while pictures differ from it by 0.30)" in str(
        found[2]
    )
    assert torch.equal(run.model[0].weight, good)  # not one of the states after the collapse began


def test_an_empty_picture_of_an_empty_scene_is_no_collapse():
    run, recovery = Run(), Recovery(patience=2)
    for step in range(1, 9):
        assert recovery.check(step, run.model, run.optimizer, {"loss": 1.0}, batch(1e-5, 0.001)) is None


def test_a_new_run_knows_nothing_of_the_last():
    run, recovery = Run(), Recovery()
    recovery.check(1, run.model, run.optimizer, {"loss": 1.0})
    recovery.check(2, run.model, run.optimizer, {"loss": math.nan})
    recovery.begin()
    assert recovery.factor == 1
    with pytest.raises(FloatingPointError):
        recovery.check(1, run.model, run.optimizer, {"loss": math.nan})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_rollbacks": -1}, "max_rollbacks must be >= 0"),
        ({"learning_rate_factor": 1.0}, r"learning_rate_factor must be in \(0, 1\), got 1.0"),
        ({"keep_every": 0}, "keep_every must be > 0"),
        ({"patience": 0}, "patience must be > 0"),
        ({"min_opacity": 0.0}, "min_opacity must be > 0"),
    ],
)
def test_numbers_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Recovery(**options)
