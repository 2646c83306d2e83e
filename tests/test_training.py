import math
import time

import pytest
import torch

from dnerf.backgrounds import ConstantBackground, RandomBackground
from dnerf.data import SyntheticData
from dnerf.deformations import DisplacementDeformation
from dnerf.error_map import UNSEEN, ErrorMap
from dnerf.fields import DeformedField, NeRFField
from dnerf.losses import OpacityEntropyLoss, PhotometricLoss
from dnerf.optimizers import rate_factor
from dnerf.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.time_window import TimeWindow
from dnerf.training import Trainer

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))


@pytest.fixture(scope="module")
def frames():
    return SyntheticData(make_scene("static"), 24, num_train=8).frames("train")


def small_renderer(background=None, density_shift=-1.0):
    torch.manual_seed(0)
    field = DeformedField(
        DisplacementDeformation(2, 32, (), position_frequencies=4, time_frequencies=2),
        NeRFField(2, 32, (), position_frequencies=4, density_shift=density_shift),
    )
    return Renderer(field, StratifiedSampler(24, BOX), RandomBackground() if background is None else background)


def trainer(**changes):
    return Trainer(**{"num_steps": 20, "num_rays": 64, "progress_bar": False, "log_every": 5, **changes})


def weights(renderer):
    return torch.cat([p.detach().flatten() for p in renderer.parameters()])


def test_loss_falls(frames):
    renderer = small_renderer()
    records = []
    trainer(num_steps=150, num_rays=256, learning_rates={"": 5e-3}).fit(
        renderer, frames, callbacks=[lambda record, _: records.append(record)]
    )
    first, last = records[0].losses["loss"], sum(r.losses["loss"] for r in records[-5:]) / 5
    assert last < 0.6 * first


def test_deformations_learn_of_half_as_many_moments_as_there_are_frames(frames):
    knots = DisplacementDeformation(1, 8, (), time_knots=100)
    renderer = Renderer(DeformedField(knots, NeRFField(1, 8, ())), StratifiedSampler(4, BOX), RandomBackground())
    trainer(num_steps=1).fit(renderer, frames)
    assert knots.encode_times.num_used == 4
    assert knots.encode_times.knots.shape == (100, 4)


def test_a_time_window_begins_with_few_frames(frames):
    class Watched(TimeWindow):
        def num_frames(self, count, progress):
            nums_frames.append(super().num_frames(count, progress))
            return nums_frames[-1]

    nums_frames: list[int] = []
    trainer(time_window=Watched(0.5, end=0.5, start=0.1)).fit(small_renderer(), frames)
    assert nums_frames == sorted(nums_frames)
    assert nums_frames[0] < nums_frames[10] == nums_frames[-1] == len(frames)


def test_rates_are_held_until_all_frames_are_in(frames):
    def factors(**settings):
        found = []
        trainer(num_steps=20, log_every=1, final_learning_rate=0.1, **settings).fit(
            small_renderer(), frames, callbacks=[lambda record, _: found.append(record.learning_rate_factor)]
        )
        return found

    held = factors(time_window=TimeWindow(0.5, end=0.5))
    assert held[:11] == [1.0] * 11
    # The other ten steps go through what a training of ten steps goes through, one step late.
    assert held[11:] == pytest.approx([0.1 ** (step / 10) for step in range(1, 10)])
    assert factors(time_window=TimeWindow(end=1.0)) == [1.0] * 20


def test_rays_are_drawn_where_pictures_are_wrong(frames):
    class Watched(ErrorMap):
        def learn(self, indices, errors):
            drawn.append((self.errors.clone(), indices))
            super().learn(indices, errors)

    drawn: list[tuple[torch.Tensor, torch.Tensor]] = []
    error_map = Watched(share=0.5, resolution=8)
    window = TimeWindow(0.5, end=0.5, start=0.1)
    trainer(num_steps=40, num_rays=512, error_map=error_map, time_window=window).fit(small_renderer(), frames)
    size = frames.num_pixels // len(frames)
    few = len(window.frames_in(frames.times, 0.0))
    assert len(set((drawn[0][1] // size).tolist())) <= few < len(frames)
    known, indices = drawn[-1]
    rows, columns = indices % size // 24 // 3, indices % 24 // 3
    wrong = known[indices // size, rows, columns]
    assert float(wrong[256:].mean()) > 2 * float(wrong[:256].mean())  # guided rays beside even ones
    assert bool((error_map.errors < UNSEEN).all())


def test_training_begins_with_a_map_that_knows_nothing(frames):
    made = trainer(num_steps=3, error_map=ErrorMap(resolution=8))
    one, two = small_renderer(), small_renderer()
    made.fit(one, frames)
    made.fit(two, frames)
    assert torch.equal(weights(one), weights(two))


@pytest.mark.parametrize("name", ["time_window", "error_map"])
def test_the_name_of_a_part_is_no_part(name):
    with pytest.raises(ValueError, match=f"{name} must be of .* or null, got 'guided'"):
        trainer(**{name: "guided"})


def test_same_seed_gives_the_same_weights(frames):
    one, two, other = small_renderer(), small_renderer(), small_renderer()
    trainer().fit(one, frames, seed=3)
    trainer().fit(two, frames, seed=3)
    trainer().fit(other, frames, seed=4)
    assert torch.equal(weights(one), weights(two))
    assert not torch.equal(weights(one), weights(other))


def test_time_limit_ends_training_and_its_schedule(frames):
    renderer = small_renderer()
    record = trainer(num_steps=10**9, max_seconds=0.5, log_every=1).fit(renderer, frames)
    assert 0.5 <= record.seconds < 5
    # The last step was taken just before the limit, so its factor is near the schedule's end, 0.1.
    assert record.learning_rate_factor < 0.3


def test_records_come_every_log_every_steps_and_at_the_end(frames):
    steps = []
    trainer(num_steps=13, log_every=5).fit(small_renderer(), frames, callbacks=[lambda r, _: steps.append(r.step)])
    assert steps == [1, 5, 10, 13]


def test_callbacks_do_not_count_as_training_time(frames):
    record = trainer(num_steps=4, log_every=1).fit(small_renderer(), frames, callbacks=[lambda *_: time.sleep(0.5)])
    assert record.seconds < 1.5  # 2 s asleep


@pytest.mark.parametrize(("schedule", "factor"), [("exponential", 0.01**0.5), ("cosine", 0.505), ("constant", 1.0)])
def test_schedule_halfway(schedule, factor):
    assert math.isclose(rate_factor(schedule, 0.01, 0, 0.5, 1000), factor, rel_tol=1e-12)


def test_warmup_rises_from_near_zero():
    assert [round(rate_factor("constant", 1.0, 9, 0, step), 9) for step in (0, 4, 9, 20)] == [0.1, 0.5, 1.0, 1.0]


def test_longest_prefix_gives_the_learning_rate():
    renderer = small_renderer()
    optimizer = trainer(learning_rates={"": 1.0, "field": 2.0, "field.deformation": 3.0}).optimizer(renderer)
    rates = {id(p): group["lr"] for group in optimizer.param_groups for p in group["params"]}
    for name, parameter in renderer.named_parameters():
        assert rates[id(parameter)] == (3.0 if name.startswith("field.deformation") else 2.0)


def test_a_star_in_a_learning_rates_name_stands_for_anything():
    renderer = small_renderer()
    rates = {"": 1.0, "field.deformation": 2.0, "field.deformation*.output": 3.0, "*nowhere": 4.0}
    optimizer = trainer(learning_rates=rates).optimizer(renderer)
    found = {id(p): group["lr"] for group in optimizer.param_groups for p in group["params"]}
    named = {name: found[id(p)] for name, p in renderer.named_parameters()}
    assert named["field.deformation.mlp.output.weight"] == named["field.deformation.mlp.output.bias"] == 3.0
    assert named["field.deformation.mlp.hidden.0.weight"] == 2.0
    assert set(named.values()) == {1.0, 2.0, 3.0}


def test_broken_loss_is_reported_with_step_and_parameters(frames):
    renderer = small_renderer()
    with torch.no_grad():
        renderer.field.canonical.to_density.bias.fill_(math.nan)
    with pytest.raises(FloatingPointError, match=r"step 1: .*loss.*field\.canonical\.to_density\.bias"):
        trainer().fit(renderer, frames)


def test_random_background_needs_alpha():
    opaque = SyntheticData(make_scene("static"), 8, num_train=1, background="white").frames("train")
    with pytest.raises(ValueError, match="background: a random one needs frames with alpha"):
        trainer().fit(small_renderer(), opaque)
    trainer(num_steps=1).fit(small_renderer(ConstantBackground("white")), opaque)


@pytest.mark.parametrize("name", ["num_steps", "num_rays", "max_seconds", "target_samples", "log_every"])
def test_numbers_must_be_positive(name):
    with pytest.raises(ValueError, match=f"{name} must be > 0"):
        trainer(**{name: 0})


def test_losses_add_up_and_are_logged_by_name(frames):
    records = []
    losses = {"rgb": PhotometricLoss("huber"), "haze": OpacityEntropyLoss(0.1)}
    trainer(num_steps=1, losses=losses).fit(small_renderer(), frames, callbacks=[lambda r, _: records.append(r)])
    terms = records[0].losses
    assert terms.keys() == {"loss", "rgb", "haze"}
    assert math.isclose(terms["loss"], terms["rgb"] + terms["haze"], rel_tol=1e-5)
    assert terms["haze"] > 0


def test_losses_know_how_much_of_training_is_over(frames):
    class Told(PhotometricLoss):
        def set_progress(self, progress):
            told.append(progress)

    told = []
    trainer(num_steps=5, losses={"rgb": Told()}).fit(small_renderer(), frames)
    assert told == [0.0, 0.2, 0.4, 0.6, 0.8]


def test_a_loss_that_takes_turns_counts_as_often(frames):
    records = []
    trainer(
        num_steps=6,
        log_every=1,
        losses={"rgb": PhotometricLoss(), "haze": OpacityEntropyLoss(0.1)},
        loss_every={"haze": 3, "another": 2},
    ).fit(small_renderer(), frames, callbacks=[lambda r, _: records.append(r)])
    assert [r.step for r in records if "haze" in r.losses] == [3, 6]
    for record in records:
        terms = record.losses
        assert math.isclose(terms["loss"], terms["rgb"] + 3 * terms.get("haze", 0), rel_tol=1e-5)


def test_a_step_without_any_loss_changes_nothing(frames):
    renderer, seen = small_renderer(), []
    before = weights(renderer)
    trainer(num_steps=2, log_every=1, losses={"rgb": PhotometricLoss()}, loss_every={"rgb": 2}).fit(
        renderer, frames, callbacks=[lambda r, model: seen.append(torch.equal(weights(model), before))]
    )
    assert seen == [True, False]


@pytest.mark.parametrize(("every", "expected"), [(0, "> 0"), (-1, "> 0"), (1.5, "a whole number")])
def test_turns_must_be_whole_and_positive(every, expected):
    with pytest.raises(ValueError, match=rf"loss_every\.haze must be {expected}"):
        trainer(loss_every={"haze": every})


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("learning_rates", "fast", "learning_rates must hold values by name, got 'fast'"),
        ("learning_rates", {"": 1e-3, "field": "fast"}, "learning_rates.field must be a number, got 'fast'"),
        ("learning_rates", {"": -1e-3}, r"learning_rates\. must be >= 0 and finite, got -0.001"),
        ("loss_every", "often", "loss_every must hold values by name, got 'often'"),
    ],
)
def test_values_by_name_are_named_when_they_are_wrong(name, value, expected):
    with pytest.raises(ValueError, match=expected):
        trainer(**{name: value})


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("warmup_steps", -2, "warmup_steps must be >= 0 and finite, got -2"),
        ("warmup_steps", 1.5, "warmup_steps must be a whole number, got 1.5"),
        ("num_rays", 100.5, "num_rays must be a whole number, got 100.5"),
        ("epsilon", -1, "epsilon must be >= 0 and finite, got -1"),
        ("betas", (0.9,), r"betas must be two numbers in \[0, 1\), got \(0.9,\)"),
        ("betas", (0.9, 1.0), r"betas must be two numbers in \[0, 1\), got \(0.9, 1.0\)"),
        ("orthogonal", "field", "orthogonal must be a list of names' beginnings, got 'field'"),
    ],
)
def test_settings_of_the_optimizer_are_checked(name, value, expected):
    with pytest.raises(ValueError, match=expected):
        trainer(**{name: value})


def test_a_training_without_a_second_left_is_refused(frames):
    with pytest.raises(ValueError, match=r"seconds must be in \[0, max_seconds\) = \[0, 1\), got 2.0"):
        trainer(max_seconds=1).fit(small_renderer(), frames, seconds=2.0)
