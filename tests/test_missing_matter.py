"""What pictures show and the model lacks, and the space-time volumes that join for it."""

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from dnerf.backgrounds import RandomBackground
from dnerf.checkpoints import load_weights, save_weights
from dnerf.compositing import Rendering
from dnerf.data import SyntheticData
from dnerf.data.frames import Frames
from dnerf.deformations import IdentityDeformation
from dnerf.error_map import ErrorMap
from dnerf.fields import DeformedField, GridField, SpaceTimeVolumes
from dnerf.missing_matter import LACKING, NEEDED, MissingMatterCheck, lacking_opacity
from dnerf.motion_losses import SteadyMatterLoss
from dnerf.renderer import Renderer
from dnerf.run_state import CheckpointFolder
from dnerf.samplers import OccupancySampler
from dnerf.scenes import make_scene
from dnerf.time_window import TimeWindow
from dnerf.training import Trainer

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))


@pytest.fixture(scope="module")
def frames() -> Frames:
    return SyntheticData(make_scene("orbiting_balls"), 16, num_train=8).frames("train")


def a_renderer(*, seed: int = 0, density_shift: float = -7.0) -> Renderer:
    """One whose volumes wait; it is too thin for a few steps to find anything."""
    torch.manual_seed(seed)
    volumes = SpaceTimeVolumes(BOX, (4,), (4,), num_features=2, waits=True)
    canonical = GridField(
        BOX, (4, 8), 2, hidden_features=16, time_terms=2, space_time=volumes, density_shift=density_shift
    )
    sampler = OccupancySampler(BOX, 0.2, 8, num_probes=512, pad_to=1)
    return Renderer(DeformedField(IdentityDeformation(), canonical), sampler, RandomBackground())


def volumes_of(renderer: Renderer) -> SpaceTimeVolumes:
    return next(part for part in renderer.modules() if isinstance(part, SpaceTimeVolumes))


def rendering(rgb: torch.Tensor, opacity: torch.Tensor, background: torch.Tensor) -> Rendering:
    return Rendering(rgb=rgb, opacity=opacity, depth=torch.zeros_like(opacity), background=background)


@given(seed=st.integers(0, 1000), has_alpha=st.booleans(), shown=st.floats(0.51, 1))
def test_a_model_with_more_than_half_the_opacity_lacks_none(seed: int, has_alpha: bool, shown: float) -> None:
    """Whatever the matter's and the background's colours are, with alpha and without."""
    generator = torch.Generator().manual_seed(seed)
    colors, background = torch.rand(2, 100, 3, generator=generator)
    truth = torch.rand(100, generator=generator)
    rgb = truth[:, None] * colors if has_alpha else truth[:, None] * colors + (1 - truth[:, None]) * background
    rgba = torch.cat([rgb, (truth if has_alpha else torch.ones(100))[:, None]], dim=-1)
    found = lacking_opacity(rendering(rgb, shown * truth, background), rgba, has_alpha=has_alpha, num_even=100)
    assert found[LACKING] == 0 < found[NEEDED]


def test_what_is_lacking_is_counted_among_rays_that_were_drawn_evenly() -> None:
    background = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.5, 0.5, 0.5], [0.2, 0.2, 0.2], [0.0, 0.0, 0.0]])
    rgb = torch.tensor([[0, 0.8, 0], [1, 1, 0.4], [0.5, 0.5, 0.5], [0.2, 0.3, 0.2], [0, 0, 0.9]])
    alpha = torch.tensor([0.9, 1.0, 0.0, 0.5, 1.0])
    rgba = torch.cat([rgb, alpha[:, None]], dim=-1)
    shown = rendering(rgb, torch.tensor([0.0, 0.4, 0.0, 1.0, 0.0]), background)
    for has_alpha, num_even, needed, lacking in (
        (True, 4, 2.4, 1.9),
        (True, 5, 3.4, 2.9),
        (False, 4, 1.5, 0.8),  # contrasts 0.8, 0.6, 0, 0.1, of which 0.4 is enough for the second
        (False, 5, 2.4, 1.7),
        (True, 0, 0.0, 0.0),
    ):
        found = lacking_opacity(shown, rgba, has_alpha=has_alpha, num_even=num_even)
        assert float(found[NEEDED]) == pytest.approx(needed / 5)
        assert float(found[LACKING]) == pytest.approx(lacking / 5)


@pytest.mark.parametrize(("lacking", "joins"), [(0.011, True), (0.0099, False), (float("nan"), False)])
def test_volumes_join_where_more_than_a_share_is_lacking(lacking: float, joins: bool) -> None:
    model, check = a_renderer(), MissingMatterCheck(0.1)
    assert check(7, model, {NEEDED: 0.1, LACKING: lacking}) == joins
    assert volumes_of(model).has_joined == joins
    assert check(8, model, {NEEDED: 0.1, LACKING: 0.1}) != joins  # those that have joined do not join again


def test_a_batch_without_matter_and_a_model_without_volumes_are_left_alone() -> None:
    check = MissingMatterCheck()
    assert not check(1, a_renderer(), {NEEDED: 0.0, LACKING: 0.0})
    assert not check(1, nn.Linear(1, 1), {NEEDED: 1.0, LACKING: 1.0})


def test_it_looks_every_so_many_steps_between_two_points() -> None:
    check = MissingMatterCheck(begin=0.4, end=0.6, every=10, min_steps=0)
    due = [step for step in range(1, 101) if check.is_due(step, step / 100)]
    assert due == [40, 50, 60]
    late = MissingMatterCheck(begin=0.4, end=0.6, every=10, min_steps=55)
    assert [step for step in range(1, 101) if late.is_due(step, step / 100)] == [60]
    assert not any(MissingMatterCheck().is_due(step, step / 300) for step in range(1, 199))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"share": 0.0}, "share must be > 0"),
        ({"share": 1.0}, r"share must be in \(0, 1\), got 1.0"),
        ({"every": 0}, "every must be > 0"),
        ({"min_steps": -1}, "min_steps must be >= 0"),
        ({"begin": 0.6, "end": 0.5}, r"end must be in \(0.6, 1\], above begin, got 0.5"),
        ({"end": 1.1}, "end must be in"),
    ],
)
def test_numbers_out_of_range_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MissingMatterCheck(**options)


def trainer(**changes: object) -> Trainer:
    options = {
        "num_steps": 24, "num_rays": 128, "target_samples": 512, "log_every": 6, "progress_bar": False,
        "learning_rates": {"": 1e-2}, "missing_matter": MissingMatterCheck(begin=0.4, every=4, min_steps=0),
    }  # fmt: skip
    return Trainer(**{**options, **changes})  # type: ignore[arg-type]


def test_they_join_in_training_and_learn_from_then_on(frames: Frames) -> None:
    """So short a training finds nothing; the tables stay as they were until they are asked."""
    seen: list[tuple[int, bool, bool]] = []
    renderer = a_renderer()
    fresh = volumes_of(a_renderer()).tables[0].detach()

    def look(record: object, model: Renderer) -> None:
        volumes = volumes_of(model)
        seen.append((record.step, volumes.has_joined, torch.equal(volumes.tables[0], fresh)))  # type: ignore[attr-defined]

    trainer().fit(renderer, frames, callbacks=[look])
    assert seen == [(1, False, True), (6, False, True), (12, True, True), (18, True, False), (24, True, False)]
    assert renderer.field.canonical.has_changes


def test_rays_drawn_where_pictures_are_wrong_do_not_count(frames: Frames, monkeypatch: pytest.MonkeyPatch) -> None:
    counted: list[tuple[int, int]] = []

    def watched(seen: Rendering, rgba: torch.Tensor, *, has_alpha: bool, num_even: int) -> dict[str, torch.Tensor]:
        counted.append((num_even, len(rgba)))
        return lacking_opacity(seen, rgba, has_alpha=has_alpha, num_even=num_even)

    monkeypatch.setattr("dnerf.steps.lacking_opacity", watched)
    for error_map, share in ((None, 0.0), (ErrorMap(share=0.25, resolution=8), 0.25)):
        counted.clear()
        trainer(num_steps=3, error_map=error_map).fit(a_renderer(), frames)
        assert len(counted) == 3
        assert all(even == count - int(share * count) for even, count in counted)


def test_volumes_that_wait_say_nothing() -> None:
    volumes = volumes_of(a_renderer())
    positions, times = torch.rand(7, 3), torch.rand(7)
    assert torch.equal(volumes(positions, times), torch.zeros(7, 2))
    volumes.join()
    assert volumes(positions, times).abs().max() > 0


def test_they_wait_until_all_frames_are_in(frames: Frames) -> None:
    joined: list[bool] = []
    trainer(time_window=TimeWindow(0.5, end=0.7)).fit(
        a_renderer(), frames, callbacks=[lambda _, model: joined.append(volumes_of(model).has_joined)]
    )
    assert joined == [False] * 5  # 0.6 of the training, when the looking ends, is over by then


def test_they_go_on_waiting_where_enough_is_shown_and_cost_nothing(frames: Frames) -> None:
    """Then training is, to the last bit, one without the check, with the same field."""
    weights = []
    for check in (MissingMatterCheck(0.999, begin=0.4, every=4, min_steps=0), None):
        renderer = a_renderer(density_shift=0.0)
        trainer(missing_matter=check).fit(renderer, frames)
        assert not volumes_of(renderer).has_joined
        weights.append(torch.cat([p.detach().flatten() for p in renderer.parameters()]))
    assert torch.equal(*weights)
    assert not renderer.field.canonical.has_changes


def test_a_run_that_stopped_after_they_joined_goes_on_bit_for_bit(frames: Frames, tmp_path: Path) -> None:
    whole, folder = a_renderer(), CheckpointFolder(tmp_path)
    trainer().fit(whole, frames)

    class Stopped(Exception):
        pass

    def stop(record: object, _: Renderer) -> None:
        if record.step == 18:  # type: ignore[attr-defined]
            raise Stopped

    with pytest.raises(Stopped):
        trainer(checkpoint_every=14).fit(a_renderer(), frames, checkpoints=folder, callbacks=[stop])
    continued = a_renderer(seed=1)
    trainer().fit(continued, frames, checkpoints=folder, resume=True)
    assert volumes_of(continued).has_joined
    for name, value in whole.state_dict().items():
        assert torch.equal(continued.state_dict()[name], value), name


def test_weights_know_whether_they_have_joined(tmp_path: Path) -> None:
    for joins in (False, True):
        saved, loaded = a_renderer(), a_renderer(seed=1)
        if joins:
            volumes_of(saved).join()
        save_weights(saved, tmp_path / "model.safetensors")
        load_weights(loaded, tmp_path / "model.safetensors")
        assert volumes_of(loaded).has_joined == joins
        assert loaded.field.canonical.has_changes == joins
    assert "joined" not in SpaceTimeVolumes(BOX).state_dict()


def test_a_model_brought_back_waits_again() -> None:
    """Its flag lies elsewhere in memory then, and once they join: recorded graphs know a model by its addresses."""
    renderer = a_renderer()
    volumes, state = volumes_of(renderer), {name: value.clone() for name, value in renderer.state_dict().items()}
    places = [volumes.joined.data_ptr()]
    volumes.join()
    places.append(volumes.joined.data_ptr())
    renderer.load_state_dict(state)
    places.append(volumes.joined.data_ptr())
    assert not volumes.has_joined
    assert places[0] != places[1] != places[2]


def test_a_price_on_change_holds_for_them_too(frames: Frames) -> None:
    """`steady` looks at contents where a field has them; once volumes have joined, at what the field shows."""
    renderer = a_renderer()
    torch.nn.init.normal_(volumes_of(renderer).tables[0])
    rays, rgba = frames.pixels(torch.arange(0, frames.num_pixels, 7))
    prices = []
    for _ in range(2):
        generator = torch.Generator().manual_seed(0)
        seen = renderer(rays, generator=generator)
        price = SteadyMatterLoss(1.0)(seen, rgba[:, :3], renderer)
        prices.append(float(price.detach()))
        volumes_of(renderer).join()
    assert torch.autograd.grad(price, volumes_of(renderer).tables[0])[0].abs().sum() > 0
    assert prices[0] == 0 < prices[1]
