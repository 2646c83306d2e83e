"""What a scene needs: evidence of images, contests of candidates, decisions, and how they are kept."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import pytest
import torch
from small_runs import BOX as CORNERS
from small_runs import small_frames, small_renderer, small_trainer, weights

from dnerf.core.backgrounds import RandomBackground
from dnerf.core.cameras import Intrinsics, look_at
from dnerf.data import Frames, SyntheticData
from dnerf.data.bounds import fit_box
from dnerf.fields import GridField
from dnerf.planning import Decision, Evidence, Finding, Part, Plan, make_plan
from dnerf.planning.evidence import (
    AppearanceEvidence,
    ColorsEvidence,
    DetailEvidence,
    ExposureEvidence,
    MotionEvidence,
    SurroundingsEvidence,
    mixture_share,
)
from dnerf.planning.plan import fingerprint, load_plan, settled
from dnerf.planning.planner import LEAST_DONE, LEAST_STEPS
from dnerf.planning.trials import Contender, Effort, HeldOut, contest, gain, split_frames
from dnerf.rendering import Renderer
from dnerf.samplers import OccupancyGrid, OccupancySampler
from dnerf.scenes import make_scene
from dnerf.training import AdamSettings, Trainer

BOX = torch.tensor(CORNERS)
CANDIDATES = {"slow": [], "quick": ["a.b=1"]}


def frames_of(scene: str, num_frames: int = 24, size: int = 64) -> Frames:
    return SyntheticData(make_scene(scene), size, num_train=num_frames).frames("train")


@pytest.mark.parametrize("scene", ["walker", "orbiting_balls", "snowman", "merging_balls"])
def test_silhouettes_prove_motion(scene: str) -> None:
    finding = MotionEvidence().find(frames_of(scene), BOX)
    assert finding is not None
    assert (finding.choice, finding.is_certain) == ("moves", True)


def test_silhouettes_of_a_body_at_rest_leave_it_at_rest_until_a_trial() -> None:
    finding = MotionEvidence().find(frames_of("static"), BOX)
    assert finding is not None
    assert (finding.choice, finding.is_certain) == ("still", False)


def test_ignored_pixels_hardly_change_the_box_and_do_not_pass_for_motion() -> None:
    frames = frames_of("static", 40)
    images, known = frames.images.clone(), torch.ones(40, 64, 64, dtype=torch.bool)
    for i in range(40):
        row, column = (37 * i) % 44, (53 * i) % 44
        images[i, row : row + 12, column : column + 12] = 255
        known[i, row : row + 12, column : column + 12] = False
    spoilt = replace(frames, images=images)
    masked = replace(spoilt, is_known=known.flatten())
    (motion, clean), (found, box) = ((MotionEvidence().find(x, fit_box(x)), fit_box(x)) for x in (frames, masked))
    assert motion is not None
    assert found is not None
    assert (found.choice, motion.choice) == ("still", "still")
    assert (box - clean).abs().max() < 0.3  # larger: fewer views carve
    assert (fit_box(spoilt) - clean).abs().max() > 0.9


def test_frames_of_one_time_are_still_for_certain_and_opaque_ones_tell_nothing() -> None:
    frames = frames_of("walker", 8, 16)
    still = MotionEvidence().find(replace(frames, times=torch.full_like(frames.times, 0.25)), BOX)
    assert still is not None
    assert (still.choice, still.is_certain) == ("still", True)
    opaque = replace(frames, images=frames.images[..., :3].contiguous())
    assert MotionEvidence().find(opaque, BOX) is None


def test_gain_is_the_ratio_of_whole_errors_for_equal_ratios_and_has_no_spread_then() -> None:
    worse = torch.tensor([0.1, 0.02, 0.3], dtype=torch.float64)
    mean, error = gain(worse / 2, worse)
    assert mean == pytest.approx(10 * math.log10(2))
    assert error == pytest.approx(0)
    assert gain(worse[:1] / 2, worse[:1])[1] == math.inf  # one frame says nothing of others
    assert gain(torch.tensor([math.nan]), worse[:1]) == (-math.inf, 0.0)
    assert gain(worse[:1], torch.tensor([math.inf])) == (math.inf, 0.0)


def test_gain_of_noise_is_within_two_standard_errors_nearly_always() -> None:
    generator = torch.Generator().manual_seed(0)
    counts = 0
    for _ in range(400):
        first, second = (1 + 0.2 * torch.rand(2, 16, generator=generator, dtype=torch.float64)).unbind()
        mean, error = gain(first, second)
        counts += mean > 2 * error
    assert counts / 400 < 0.06  # 2.3 % of normal ones; sixteen frames have somewhat heavier tails


def test_split_holds_every_eighth_frame_out_at_least_three_and_none_of_few() -> None:
    for count, kept in ((24, 21), (12, 9), (11, 7), (8, 4)):
        learnt, held = split_frames(small_frames(count))  # type: ignore[misc]
        assert (len(learnt), len(held)) == (kept, count - kept)
        assert not set(learnt.times.tolist()) & set(held.times.tolist())
    assert split_frames(small_frames(7)) is None
    rig = replace(small_frames(64), times=torch.linspace(0, 1, 16).repeat(4))  # four cameras, one after the other
    held = split_frames(rig)[1]  # type: ignore[index]
    seen = [(rig.poses == pose).flatten(1).all(1).nonzero()[0].item() // 16 for pose in held.poses]
    assert sorted(seen) == [0, 0, 1, 1, 2, 2, 3, 3]


def make(choices: Mapping[str, str]) -> tuple[Renderer, Trainer]:
    """A model that learns at two rates."""
    rates = {"slow": 1e-6, "quick": 2e-2, "worse": 1e-7}
    settings = AdamSettings({"default": rates[choices.get("rate", "slow")]})
    return small_renderer(), small_trainer(num_steps=800, num_rays=64, optimizer=settings)


def test_fork_continues_from_the_same_weights_and_moments() -> None:
    frames = small_frames(8)
    leading = Contender.fresh("slow", make, {}, frames, 0)
    leading.advance(Effort(4, 0.0))
    fork = leading.forked("quick", make, {"rate": "quick"}, frames, 0)
    torch.testing.assert_close(weights(fork.run.renderer), weights(leading.run.renderer), rtol=0, atol=0)
    assert (fork.run.step, fork.run.seconds) == (leading.run.step, leading.run.seconds)
    for left, right in zip(fork.run.renderer.parameters(), leading.run.renderer.parameters(), strict=True):
        for key, moment in leading.run.optimizer.state[right].items():
            torch.testing.assert_close(fork.run.optimizer.state[left][key], moment, rtol=0, atol=0)
    before = weights(leading.run.renderer)
    fork.advance(Effort(2, 0.0))
    torch.testing.assert_close(weights(leading.run.renderer), before, rtol=0, atol=0)


def test_contest_finds_the_candidate_that_learns_and_keeps_the_standing_one_of_equals() -> None:
    learnt, held = split_frames(small_frames(40))  # type: ignore[misc]
    pixels = HeldOut.of(held, 0)

    def contenders(*rates: str) -> list[Contender]:
        return [Contender.fresh(rate, make, {"rate": rate}, learnt, 0) for rate in rates]

    result = contest(contenders("slow", "quick", "worse"), pixels, Effort(160, 0.0))
    assert result.winner.choice == "quick"
    assert result.gain > 2 * result.error > 0
    assert contest(contenders("slow", "slow"), pixels, Effort(10, 0.0)).winner.choice == "slow"


def test_another_candidate_wins_by_a_standard_error() -> None:
    class Known:
        """A contender whose errors are given."""

        def __init__(self, choice: str, *errors: float) -> None:
            self.choice, self.errors = choice, torch.tensor(errors, dtype=torch.float64)
            self.run = self.trainer = MagicMock()

        def begin(self) -> None: ...
        def end(self) -> None: ...
        def advance(self, effort: Effort) -> None: ...
        def compare(self, held: HeldOut) -> None: ...

    held = MagicMock()
    held.within.return_value = held
    standing, near, clear = Known("default", 1.0, 2.0, 1.0), Known("near", 1.4, 1.5, 1.0), Known("clear", 1.1, 1.5, 0.9)
    (mean, error), (more, spread) = (gain(other.errors, standing.errors) for other in (near, clear))
    assert 0 < mean < error
    assert spread < more < 2 * spread
    assert contest([standing, near], held, Effort(1, 0.0)).winner is standing  # type: ignore[list-item]
    assert contest([standing, clear], held, Effort(1, 0.0)).winner is clear  # type: ignore[list-item]
    one = [Known("default", 2.0), Known("other", 1.0)]
    assert contest(one, held, Effort(1, 0.0)).winner is one[0]  # type: ignore[arg-type]


def part(**changes: object) -> Part:
    return Part("how fast", CANDIDATES, "slow", **{"at": 0.1, **changes})  # type: ignore[arg-type]


def test_trial_decides_and_its_winner_is_trained_on() -> None:
    plan, run = make_plan({"rate": part()}, {}, make, small_frames(40), BOX, share=0.2)
    decision = plan.decisions["rate"]
    assert (decision.choice, decision.by) == ("quick", "trial")
    assert run is not None
    assert run.step >= 80 + LEAST_STEPS
    renderer, trainer = make(plan.choices)
    record = trainer.fit(run.renderer, small_frames(40), begun=run)
    assert record.step == 800
    assert run.renderer is not renderer


def test_candidates_are_made_without_what_does_not_arise_with_them() -> None:
    made: list[Mapping[str, str]] = []

    def noting(choices: Mapping[str, str]) -> tuple[Renderer, Trainer]:
        made.append(dict(choices))
        return make(choices)

    richer = Part("what else", CANDIDATES, "quick", at=0.3, only_if={"rate": "slow"})
    plan, run = make_plan({"rate": part(), "other": richer}, {}, noting, small_frames(40), BOX, share=0.4)
    assert made == [{"rate": "slow", "other": "quick"}, {"rate": "quick", "other": "slow"}]
    assert run is not None
    assert plan.choices == made[-1]  # whose run goes on


def test_images_that_show_something_everywhere_have_surroundings() -> None:
    frames = frames_of("walker", 8, 16)
    assert SurroundingsEvidence().find(frames, BOX).choice == "alone"
    opaque = replace(frames, images=frames.images[..., :3].contiguous())
    assert SurroundingsEvidence().find(opaque, BOX).choice == "alone"  # before white, or black
    noise = torch.randint(256, opaque.images.shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    film = replace(opaque, images=noise)
    assert SurroundingsEvidence().find(film, BOX).choice == "surrounded"
    said = [
        AppearanceEvidence().find(x, BOX) for x in (film, frames, replace(film, poses=film.poses[[0, 1, 2, 0] * 2]))
    ]
    assert said == [Finding("carried", "few cameras see a place at a moment"), None, None]


@pytest.mark.parametrize(
    ("width", "choice"), [(40, "coarse"), (71, "coarse"), (170, "medium"), (330, "fine"), (513, "finest")]
)
def test_cells_are_no_smaller_than_a_pixel(width: int, choice: str) -> None:
    """Cameras at distance 4 whose images are as wide as 2.4 there: a box with sides of 2.4 fills them."""
    lens = Intrinsics(width, width, width / 0.6, width / 0.6)
    poses = torch.stack([look_at(eye).float() for eye in ((4, 0, 0), (0, -4, 0), (0, 0.1, 4))])
    frames = Frames(torch.zeros(3, width, width, 4, dtype=torch.uint8), poses, torch.tensor([0.0, 0.5, 1.0]), lens)
    box = torch.tensor([[-1.2, -1.0, -0.5], [1.2, 1.0, 0.5]])
    assert DetailEvidence().find(frames, box).choice == choice


def test_smoke_of_one_colour_before_few_cameras_is_told_from_all_else() -> None:
    """Mixtures of one colour and the background; not of two, not with alpha, and not where many cameras look."""
    frames, behind = frames_of("walker", 12, 16), torch.tensor([0.2, 0.4, 0.6])
    thickness = torch.rand(12, 16, 16, 1, generator=torch.Generator().manual_seed(0))
    thickness[:, [0, -1]] = thickness[:, :, [0, -1]] = 0
    rig = frames.poses[torch.arange(12) % 4]

    def before_plain(colors: torch.Tensor, poses: torch.Tensor = rig) -> Frames:
        images = (255 * torch.lerp(behind.expand(12, 16, 16, 3), colors, thickness)).round().to(torch.uint8)
        return replace(frames, images=images, poses=poses, background=None)

    smoke = torch.tensor([0.9, 0.8, 0.5]).expand(12, 16, 16, 3)
    two = torch.where(torch.arange(16)[:, None] < 8, smoke, torch.tensor([0.1, 0.9, 0.2]))
    both_sides = torch.where(torch.arange(16)[:, None] < 8, smoke, 2 * behind - smoke).clamp(0, 1)
    assert ColorsEvidence().find(before_plain(smoke), BOX).choice == "one"
    for other in (two, both_sides):
        assert ColorsEvidence().find(before_plain(other), BOX).choice == "many"
    assert ColorsEvidence().find(before_plain(smoke, frames.poses), BOX).choice == "many"  # twelve viewpoints
    one_each = before_plain(smoke).subset([0, 1, 2, 3])  # an image of each camera
    assert ColorsEvidence().find(one_each, BOX).choice == "many"
    assert ColorsEvidence().find(frames, BOX).choice == "many"  # with alpha
    noise = torch.randint(256, (12, 16, 16, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    everywhere = ColorsEvidence().find(replace(before_plain(smoke), images=noise), BOX)
    assert (everywhere.choice, everywhere.is_certain) == ("many", True)  # no trial may say otherwise
    assert mixture_share(before_plain(smoke), behind) == 1
    assert mixture_share(before_plain(two), behind) < 0.8


def test_trials_of_several_parts_share_one_budget() -> None:
    parts = {name: part() for name in ("first", "second", "third")}
    plan, _ = make_plan(parts, {}, make, small_frames(24), BOX, share=0.27)
    steps = [int(plan.decisions[name].why.split()[0]) for name in parts]
    assert all(number >= LEAST_STEPS for number in steps)
    assert sum(steps) <= 0.27 * 800


def test_first_steps_are_of_the_first_candidate_and_short_trainings_stay_with_it() -> None:
    made: list[str] = []
    noting = lambda choices: (made.append(choices["rate"]), make(choices))[1]  # noqa: E731
    parts, frames = {"rate": Part("how fast", CANDIDATES, "quick", at=0.1, first="slow")}, small_frames(24)
    plan, run = make_plan(parts, {}, noting, frames, BOX, share=0.08)
    assert (made, plan.decisions["rate"].by) == (["slow", "quick", "slow"], "trial")
    parts["rate"].at = 0.05  # 40 of 800 steps
    plan, run = make_plan(parts, {}, noting, frames, BOX, share=0.08)
    assert run is not None
    assert (run.step, made[3:], plan.choices) == (40, ["slow"], {"rate": "slow"})
    assert make_plan(parts, {}, noting, small_frames(6), BOX)[0].choices == {"rate": "quick"}


def test_nothing_is_trained_for_what_is_given_seen_cannot_be_tried_or_does_not_arise() -> None:
    class Sees(Evidence):
        def find(self, frames: Frames, box: torch.Tensor) -> Finding:
            return Finding("quick", "one sees it")

    parts = {"given": part(), "seen": part(evidence=Sees()), "other": part(only_if={"seen": "slow"})}
    plan, run = make_plan(parts, {"given": "quick"}, make, small_frames(24), BOX)
    assert run is None
    assert plan.choices == {"given": "quick", "seen": "quick", "other": "slow"}
    assert [plan.decisions[name].by for name in parts] == ["given", "images", "default"]
    plan, run = make_plan({"rate": part()}, {}, make, small_frames(6), BOX)
    assert (run, "too few" in plan.decisions["rate"].why) == (None, True)
    plan, run = make_plan({"rate": part(at=0.5)}, {}, make, small_frames(24), BOX, share=0.05)  # of 800 steps
    found = "budget" in plan.decisions["rate"].why, getattr(run, "step", None)
    assert found == (True, LEAST_DONE)  # frames are not held out for longer


def test_uncertain_evidence_stands_where_nothing_is_tried() -> None:
    class Guesses(Evidence):
        def find(self, frames: Frames, box: torch.Tensor) -> Finding:
            return Finding("quick", "it looks so", is_certain=False)

    plan, _ = make_plan({"rate": part(evidence=Guesses())}, {}, make, small_frames(6), BOX)
    assert (plan.choices["rate"], plan.decisions["rate"].by) == ("quick", "images")


def test_plan_is_read_as_it_was_saved_and_by_hand(tmp_path: Path) -> None:
    plan = Plan({"rate": Decision("quick", "trial", "9 steps", 0.5, 0.1, 1.5)}, fingerprint(small_frames()))
    plan.save(tmp_path / "plan.yaml")
    assert load_plan(tmp_path / "plan.yaml") == plan
    assert "quick" in plan.table()
    assert "+0.50 ± 0.10" in plan.table()
    (tmp_path / "plan.yaml").write_text("parts: {rate: quick, other: true}")
    assert load_plan(tmp_path / "plan.yaml").choices == {"rate": "quick", "other": "true"}


@pytest.mark.parametrize("text", ["parts: 3", "parts: {rate: {by: trial}}", "parts: {rate: {choice: a, foo: 1}}", "]["])
def test_broken_plans_are_refused_naming_the_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "plan.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"plan\.file: .*plan\.yaml"):
        load_plan(tmp_path / "plan.yaml")


def test_held_out_pixels_are_those_that_count() -> None:
    frames = small_frames(4)
    known = torch.arange(frames.num_pixels) % 5 > 2
    assert bool(known[HeldOut.of(replace(frames, is_known=known), 0).indices].all())


def test_cameras_that_stand_still_have_exposures_of_their_own_until_a_trial() -> None:
    frames = small_frames(12)
    rig = replace(frames, poses=frames.poses[[0, 1, 2] * 4])
    found = ExposureEvidence().find(rig, BOX)
    assert found == Finding("drifts", "3 cameras stand still, each with its own exposure", is_certain=False)
    for poses in (frames.poses, frames.poses[[0] * 12]):
        assert ExposureEvidence().find(replace(frames, poses=poses), BOX) is None


def test_what_speaks_against_a_given_choice_is_said() -> None:
    class Sees(Evidence):
        def find(self, frames: Frames, box: torch.Tensor) -> Finding:
            return Finding("slow", "nothing is quick")

    parts = {"rate": part(evidence=Sees()), "more": Part("", CANDIDATES, "slow", at=0.2, only_if={"rate": "slow"})}
    plan, _ = make_plan(parts, {"rate": "quick", "more": "quick"}, make, small_frames(6), BOX)
    assert plan.decisions["rate"].why == "as set, though nothing is quick"
    assert plan.decisions["more"].why == "as set, though the question arises with rate=slow only"
    plan, _ = make_plan(parts, {"rate": "slow", "more": "quick"}, make, small_frames(6), BOX)
    assert [decision.why for decision in plan.decisions.values()] == ["as set", "as set"]


def test_plans_with_unknown_parts_or_about_other_data_are_refused(tmp_path: Path) -> None:
    file, parts, data = tmp_path / "plan.yaml", {"rate": part()}, fingerprint(small_frames())
    Plan({"rate": Decision("quick", "trial", "")}, data).save(file)
    assert settled(parts, {}, file, data) == {"rate": "quick"}
    with pytest.raises(ValueError, match=r"plan\.yaml is about another data set"):
        settled(parts, {}, file, fingerprint(small_frames(5)))
    with pytest.raises(ValueError, match=r"plan\.yaml: rate is none of the parts other"):
        settled({"other": part()}, {}, file, data)
    with pytest.raises(ValueError, match=r"^plan\.speed is none of the parts rate"):
        settled(parts, {"speed": True}, None, data)


def test_part_names_its_candidates() -> None:
    assert [part().named("rate", choice) for choice in ("slow", True, False)] == ["slow", "quick", "slow"]
    with pytest.raises(ValueError, match=r"plan\.rate must be one of slow, quick, true, false or null, got 'swift'"):
        part().named("rate", "swift")
    with pytest.raises(ValueError, match="default"):
        Part("", CANDIDATES, "swift")
    with pytest.raises(ValueError, match="candidates"):
        Part("", {"slow": []}, "slow")


def test_fork_with_more_outputs_renders_the_same_and_keeps_what_it_knew() -> None:
    """Harmonics and waves are new; density and colour go on as they were."""

    def grids(choices: Mapping[str, str]) -> tuple[Renderer, Trainer]:
        torch.manual_seed(len(choices))
        degree = 2 if "rate" in choices else None
        field = GridField(BOX, (4, 8), hidden_features=8, temporal_terms=1 + len(choices), view_degree=degree)
        grid = OccupancyGrid(BOX, 8, num_slabs=2, update_every=3, num_probes=64)
        return Renderer(field, OccupancySampler(grid, 0.1, pad_to=64), RandomBackground()), small_trainer(num_steps=50)

    frames = small_frames(8)
    leading = Contender.fresh("", grids, {}, frames, 0)
    leading.advance(Effort(6, 0.0))
    fork = leading.forked("quick", grids, {"rate": "quick"}, frames, 0)
    positions, times = torch.rand(64, 3) * 2 - 1, torch.rand(64)
    directions = torch.nn.functional.normalize(torch.randn(64, 3), dim=-1)
    before, after = (x.run.renderer.field(positions, directions, times) for x in (leading, fork))
    torch.testing.assert_close(after.density, before.density)
    torch.testing.assert_close(after.rgb, before.rgb)
    assert len(fork.run.renderer.field.head.output.bias) == 2 + 3 * (2 + 8)
