"""Motion read off what a field holds: contents that move in a known way, and such that hold nothing to find."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from dnerf.checkpoints import load_weights, save_weights
from dnerf.compositing import FieldOutput
from dnerf.data import SyntheticData
from dnerf.data.frames import Frames
from dnerf.deformations import CarriedBodies, FlowDeformation, IdentityDeformation
from dnerf.deformations.velocities import NetworkVelocity
from dnerf.fields import DeformedField, RadianceField, SpaceTimeVolumes
from dnerf.motion import carry, motion_model
from dnerf.motion_search import FoundMotion, MotionSearch, has_unknown_motion
from dnerf.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.seen_matter import seen_matter

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
RADIUS = 0.3
COLORS = torch.tensor([[0.9, 0.2, 0.1], [0.1, 0.3, 0.9]])

Path = Callable[[Tensor], Tensor]
"""Centre (..., 3) of a ball at times (...,)."""


def going(times: Tensor) -> Tensor:
    """1.2 units along x in a unit of time, from -0.6 to 0.6."""
    return torch.stack([1.2 * (times - 0.5), torch.full_like(times, 0.6), torch.zeros_like(times)], dim=-1)


def resting(times: Tensor) -> Tensor:
    return torch.stack([torch.zeros_like(times), torch.full_like(times, -0.6), torch.zeros_like(times)], dim=-1)


class Balls(RadianceField):
    """Balls with soft edges, each on its path: what space-time volumes hold once they have learnt, without learning."""

    def __init__(self, *paths: Path, waits: bool = False) -> None:
        super().__init__()
        self.paths = paths
        self.volumes = SpaceTimeVolumes(BOX, (2,), (2,), num_features=1, waits=waits)
        self.brightness = torch.nn.Parameter(torch.ones(()))

    def _densities(self, positions: Tensor, times: Tensor) -> Tensor:
        distances = torch.stack([(positions - path(times)).norm(dim=-1) for path in self.paths], dim=-1)
        return 40 * torch.sigmoid((RADIUS - distances) / 0.03)

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self._densities(positions, times).sum(-1)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        densities = self._densities(positions, times)
        shares = densities / densities.sum(-1, keepdim=True).clamp(min=1e-6)
        colors = shares @ COLORS[: len(self.paths)].to(positions)
        return FieldOutput(densities.sum(-1), self.brightness * colors)


def a_renderer(*paths: Path, waits: bool = False, canonical: RadianceField | None = None) -> Renderer:
    torch.manual_seed(0)
    velocity = NetworkVelocity(
        BOX, 2, 32, position_frequencies=1, time_frequencies=1, activation="relu", smoothness=1, twists=1.0
    )
    flow = FlowDeformation(velocity, 0.5, solver="midpoint", num_steps=10)
    canonical = Balls(*paths, waits=waits) if canonical is None else canonical
    return Renderer(DeformedField(IdentityDeformation(), canonical, motion_flow=flow), StratifiedSampler(64))


def a_search(**settings: float) -> MotionSearch:
    given = {"num_steps": 120, "num_points": 256, "num_rays": 4000, "learning_rate": 2e-2, "step": 0.05, **settings}
    return MotionSearch(**given)


def state(renderer: Renderer) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in renderer.state_dict().items()}


@pytest.fixture(scope="module")
def frames() -> Frames:
    """Only their cameras and times matter."""
    return SyntheticData(make_scene("static"), 24, num_train=16).frames("train")


@pytest.fixture(scope="module")
def found(frames: Frames) -> tuple[Renderer, FoundMotion, dict[str, Tensor]]:
    renderer = a_renderer(going, resting)
    before = state(renderer)
    result = a_search()(renderer, frames)
    assert result is not None
    return renderer, result, before


def points_of(path: Path, time: float, count: int = 200) -> Tensor:
    directions = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=torch.Generator().manual_seed(1)), dim=-1
    )
    return path(torch.full((count,), time)) + 0.9 * RADIUS * directions


@pytest.mark.parametrize(("start", "end"), [(0.0, 1.0), (0.5, 0.1), (0.9, 0.4)])
def test_points_of_a_ball_that_goes_are_carried_along_and_those_at_rest_stay(
    found: tuple[Renderer, FoundMotion, dict[str, Tensor]], start: float, end: float
) -> None:
    """The centre of a moved ball has its closed form; that it turns shows nowhere, so points have none."""
    model = motion_model(found[0])
    for path in (going, resting):
        moved, residual = carry(model, points_of(path, start), start, end)
        centre = path(torch.tensor(end))
        # A tenth of the way at most, from 120 steps; a model in which nothing moves is off by the whole of it.
        assert (moved.mean(0) - centre).norm() < 0.1 * 1.2 * abs(end - start) + 0.01
        assert ((moved - centre).norm(dim=-1) - 0.9 * RADIUS).abs().mean() < 0.05
        assert residual.max() < 1e-4


def test_a_search_says_what_it_has_come_to(found: tuple[Renderer, FoundMotion, dict[str, Tensor]]) -> None:
    renderer, result, _ = found
    assert result.is_motion
    assert result.carried < 0.3 * result.deformed
    assert renderer.field.has_found_motion
    assert not has_unknown_motion(renderer)
    assert motion_model(renderer) is renderer.field.motion_flow


@pytest.mark.parametrize(
    ("deformed", "carried", "better"),
    [(0.1, 0.089, True), (0.1, 0.091, False), (0.1, 0.2, False), (0.0, 0.0, False), (0.1, math.nan, False)],
)
def test_a_flow_is_taken_only_where_it_explains_a_tenth_more_than_the_deformation(
    deformed: float, carried: float, better: bool
) -> None:
    assert FoundMotion(deformed, carried).is_motion == better


def test_all_but_the_motion_is_as_before(found: tuple[Renderer, FoundMotion, dict[str, Tensor]]) -> None:
    renderer, _, before = found
    for name, value in renderer.state_dict().items():
        assert torch.equal(value, before[name]) == (not name.startswith(("field.motion_flow.", "field.found")))
    assert all(parameter.requires_grad for parameter in renderer.parameters())
    assert all(module.training for module in renderer.modules())
    assert renderer.field.canonical.brightness.grad is None


def test_motion_is_kept_in_the_weights(found: tuple[Renderer, FoundMotion, dict[str, Tensor]], tmp_path) -> None:
    renderer, again = found[0], a_renderer(going, resting)
    assert has_unknown_motion(again)
    save_weights(renderer, tmp_path / "model.safetensors")
    load_weights(again, tmp_path / "model.safetensors")
    points = points_of(going, 0.2)
    assert torch.equal(
        carry(motion_model(again), points, 0.2, 0.8)[0], carry(motion_model(renderer), points, 0.2, 0.8)[0]
    )


def test_the_same_seed_finds_the_same(frames: Frames) -> None:
    states = []
    for seed in (0, 0, 1):
        renderer = a_renderer(going)
        assert a_search(num_steps=30)(renderer, frames, seed=seed).is_motion
        states.append(torch.cat([p.detach().flatten() for p in renderer.field.motion_flow.parameters()]))
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])


@torch.no_grad()
def test_motion_that_is_found_is_behind_what_is_carried() -> None:
    """A carried body goes on its track, all else with the flow; without a velocity both are what the bodies say."""
    bodies = CarriedBodies(1, 6)
    track = going(torch.linspace(0, 1, 6))
    bodies.add(track, torch.tensor([1.0, -1.0, 1.0]), 0.4)
    flow = FlowDeformation(NetworkVelocity(BOX, 2, 16), 0.5, solver="midpoint", num_steps=8)
    field = DeformedField(IdentityDeformation(), Balls(resting), motion_flow=flow, bodies=bodies)
    field.set_found_motion(True)
    moves = 0.2 * torch.randn(50, 3).clamp(-1, 1)
    times, ends = torch.full((50,), 0.2), torch.full((50,), 0.4)
    search = MotionSearch()
    for start, end in ((going(times) + moves, going(ends) + moves), (resting(times) + moves, resting(ends) + moves)):
        torch.testing.assert_close(search._carried(flow, bodies, start, times, ends, 0.3), end, rtol=0, atol=1e-5)
        torch.testing.assert_close(carry(field.motion, start, 0.2, 0.4)[0], end, rtol=0, atol=1e-5)
    assert flow.velocity.mlp.output is not None
    flow.velocity.mlp.output.bias.fill_(0.1)
    for start, end in ((going(times) + moves, going(ends) + moves), (resting(times) + moves, resting(ends) + moves)):
        by_search = search._carried(flow, bodies, start, times, ends, 0.3)
        assert float((by_search - end).norm(dim=-1).mean()) > 1e-3
        torch.testing.assert_close(carry(field.motion, start, 0.2, 0.4)[0], by_search, rtol=0, atol=2e-3)


def test_fields_whose_volumes_wait_are_left_alone(frames: Frames) -> None:
    renderer = a_renderer(going, waits=True)
    before = state(renderer)
    assert a_search()(renderer, frames) is None
    assert not has_unknown_motion(renderer)
    assert motion_model(renderer) is renderer.field.deformation
    assert all(torch.equal(value, before[name]) for name, value in renderer.state_dict().items())


def test_nothing_is_found_where_nothing_moves_or_shows(frames: Frames) -> None:
    far = torch.tensor([9.0, 9.0, 9.0])
    still, empty = a_renderer(resting), a_renderer(lambda times: far.expand(*times.shape, 3))
    before = state(still)
    result = a_search(num_steps=10)(still, frames)
    assert result is not None
    assert not result.is_motion
    assert not still.field.has_found_motion
    assert all(torch.equal(value, before[name]) for name, value in still.state_dict().items())
    assert a_search(num_steps=10)(empty, frames) is None


class Broken(Balls):
    """Contents that no longer are numbers when points have moved."""

    def _densities(self, positions: Tensor, times: Tensor) -> Tensor:
        inside = (positions - going(times)).norm(dim=-1, keepdim=True) < RADIUS + 1e-3
        return torch.where(inside, super()._densities(positions, times), torch.nan)


def test_a_search_that_ends_in_nan_leaves_the_model_as_it_was(frames: Frames, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = a_renderer(canonical=Broken(going))
    before = state(renderer)
    # Pictures of it show nothing that is a number: matter is drawn from one without gaps.
    seen = seen_matter(a_renderer(going).eval(), frames, 2000, torch.Generator().manual_seed(0))
    monkeypatch.setattr("dnerf.motion_search.seen_matter", lambda *_: seen)
    result = a_search(num_steps=2)(renderer, frames)
    assert result is not None
    assert math.isnan(result.carried)
    assert not result.is_motion
    assert all(torch.equal(value, before[name]) for name, value in renderer.state_dict().items())


def test_modes_and_gradients_come_back_after_an_error(frames: Frames) -> None:
    renderer = a_renderer(going)
    renderer.field.canonical.brightness.requires_grad_(False)
    renderer.sampler.eval()
    with pytest.raises(RuntimeError):
        a_search()(renderer, frames.to("meta"))
    assert not renderer.field.canonical.brightness.requires_grad
    assert renderer.field.canonical.volumes.tables[0].requires_grad
    assert renderer.training
    assert not renderer.sampler.training


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_steps": 0}, "num_steps must be > 0 and finite, got 0"),
        ({"learning_rate": -1.0}, "learning_rate must be > 0 and finite, got -1.0"),
        ({"jitter": -0.1}, "jitter must be >= 0 and finite, got -0.1"),
        ({"spans": (0.3, 0.1)}, r"spans must be two times, 0 < first <= last <= 1, got \[0.3, 0.1\]"),
        ({"spans": (0.3,)}, r"spans must be two times, 0 < first <= last <= 1, got \[0.3\]"),
    ],
)
def test_wrong_settings_are_named(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MotionSearch(**settings)


def test_a_field_without_a_place_for_motion_is_refused(frames: Frames) -> None:
    renderer = Renderer(DeformedField(IdentityDeformation(), Balls(going)), StratifiedSampler(8))
    with pytest.raises(ValueError, match="needs a DeformedField with a motion_flow, this field has none"):
        a_search()(renderer, frames)


def test_nothing_is_left_of_the_gradients(found: tuple[Renderer, FoundMotion, dict[str, Tensor]]) -> None:
    assert all(parameter.grad is None for parameter in found[0].parameters())


def test_a_flow_with_a_frozen_clock_is_refused(frames: Frames) -> None:
    """Points are carried by the equation of a running clock, which is not the motion that such a flow would give."""
    renderer = a_renderer(going)
    velocity = renderer.field.motion_flow.velocity
    renderer.field.motion_flow = FlowDeformation(velocity, 0.5, clock="frozen", solver="midpoint", num_steps=10)
    with pytest.raises(ValueError, match=r"motion_flow\.clock must be running, .* got frozen"):
        a_search()(renderer, frames)
