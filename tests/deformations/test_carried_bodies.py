"""Bodies that are carried: balls of space exchanged with empty ones at home."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dnerf.checkpoints import load_weights, save_weights
from dnerf.deformations import CarriedBodies, CarriedDeformation, DisplacementDeformation, IdentityDeformation
from dnerf.deformations.carried_bodies import LEARNT_WITH, NOWHERE
from dnerf.motion import carry, follow

HOMES = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]], dtype=torch.float64)
RADII = (0.3, 0.2)


def tracks(num_knots: int = 11) -> Tensor:
    """A circle of radius one, and a line that crosses it."""
    angle = torch.linspace(0, 3, num_knots, dtype=torch.float64)
    circle = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1)
    line = torch.stack([torch.linspace(-1, 1.2, num_knots).double(), *torch.zeros(2, num_knots).double()], dim=-1)
    return torch.stack([circle, line])


def two_bodies() -> CarriedBodies:
    bodies = CarriedBodies(3, 11).double()
    for track, home, radius in zip(tracks(), HOMES, RADII, strict=True):
        bodies.add(track, home, radius)
    return bodies


def points_near(bodies: CarriedBodies, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Positions around tracks, homes and everywhere, and times."""
    generator = torch.Generator().manual_seed(seed)
    times = torch.rand(3 * count, generator=generator, dtype=torch.float64)
    middles = torch.cat(
        [bodies.centers(0, times[:count]), HOMES[torch.arange(count) % 2], torch.zeros(count, 3).double()]
    )
    spread = torch.cat([torch.full((2 * count, 1), 0.3), torch.full((count, 1), 2.0)]).double()
    return middles + spread * torch.randn(3 * count, 3, generator=generator, dtype=torch.float64), times


@given(seed=st.integers(0, 10_000))
@torch.no_grad()
def test_inverse_undoes_it_everywhere(seed: int) -> None:
    """Even where two bodies meet."""
    bodies = two_bodies()
    positions, times = points_near(bodies, 200, seed)
    torch.testing.assert_close(bodies.inverse(bodies(positions, times), times), positions, rtol=0, atol=1e-12)
    torch.testing.assert_close(bodies(bodies.inverse(positions, times), times), positions, rtol=0, atol=1e-12)


@torch.no_grad()
def test_bodies_are_at_home_homes_are_around_bodies_and_the_rest_stays() -> None:
    bodies = CarriedBodies(1, 11).double()
    bodies.add(tracks()[0], HOMES[0], 0.3)
    times = torch.rand(500, dtype=torch.float64)
    moves = torch.nn.functional.normalize(torch.randn(500, 3, dtype=torch.float64), dim=-1)
    inside, outside = 0.29 * moves, 0.31 * moves
    center = bodies.centers(0, times)
    torch.testing.assert_close(bodies(center + inside, times), HOMES[0] + inside)
    torch.testing.assert_close(bodies(HOMES[0] + inside, times), center + inside)
    for places in (center + outside, HOMES[0] + outside):
        torch.testing.assert_close(bodies(places, times), places, rtol=0, atol=0)


@torch.no_grad()
@torch.no_grad()
def test_motion_says_where_a_body_may_be_while_it_is_not_there() -> None:
    """On a straight line over a gap, at rest before and after all; matter that is where it may be stays."""
    bodies, track = CarriedBodies(3, 11).double(), tracks()[1]
    seen = track.clone()
    seen[[0, 1, 5, 6, 7, 10]] = NOWHERE
    bodies.add(seen, HOMES[0], 0.3)
    bodies.add(torch.full_like(track, NOWHERE), HOMES[1], 0.2)
    model = CarriedDeformation(bodies, IdentityDeformation())
    moves = torch.tensor([[0.05, 0.1, -0.1], [0.0, 0.0, 0.2]], dtype=torch.float64)
    for time, place in ((0.0, 0.2), (0.1, 0.2), (0.5, 0.5), (0.62, 0.62), (0.85, 0.85), (0.99, 0.9), (1.0, 0.9)):
        moved, residual = carry(model, bodies.centers(0, torch.tensor([0.3])) + moves, 0.3, time)
        torch.testing.assert_close(moved - moves, (track[0] + 2.2 * place * torch.tensor([1.0, 0, 0])).expand(2, 3))
        assert float(residual.max()) < 1e-9
    there = track[6] + moves
    torch.testing.assert_close(carry(model, there, 0.6, 0.61)[0], there)
    assert bool(bodies.is_nowhere(bodies(HOMES[0] + moves, torch.tensor([0.6, 0.6]))).all())


def test_tracks_are_straight_between_knots_and_exact_at_them() -> None:
    bodies = two_bodies()
    knots = torch.linspace(0, 1, 11, dtype=torch.float64)
    torch.testing.assert_close(bodies.centers(0, knots), tracks()[0])
    torch.testing.assert_close(
        bodies.centers(0, knots[:-1] + 0.025), torch.lerp(*tracks()[0].unfold(0, 2, 1).unbind(-1), 0.25)
    )


def test_gradients_of_tracks_and_positions() -> None:
    bodies = two_bodies().eval()
    times = torch.tensor([0.0, 0.33, 0.71, 1.0, 0.5], dtype=torch.float64)
    positions = bodies.centers(0, times).detach() + 0.1
    positions[-1] = 5.0

    def moved(track: Tensor, places: Tensor) -> Tensor:
        return torch.func.functional_call(bodies, {"tracks": track}, (places, times))

    inputs = (bodies.tracks.detach().clone().requires_grad_(), positions.requires_grad_())
    assert torch.autograd.gradcheck(moved, inputs)
    moved(*inputs).sum().backward()
    assert inputs[0].grad is not None
    assert (inputs[0].grad[0] != 0).any()
    assert (inputs[0].grad[2] == 0).all()  # there is no third body


def test_knots_share_gradients_in_training_with_known_ones_only() -> None:
    bodies = CarriedBodies(1, 41).double()
    track = tracks(41)[0]
    track[30:33] = NOWHERE
    bodies.add(track, HOMES[0], 0.3)
    times = torch.linspace(0, 1, 60, dtype=torch.float64)
    positions = bodies.centers(0, times).detach() + 0.1
    weights = torch.randn(60, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gradients, moved = [], []
    for mode in (False, True):
        bodies.train(mode)
        moved.append(bodies(positions, times))
        gradients += torch.autograd.grad((weights * moved[-1]).sum(), [bodies.tracks])
    assert torch.equal(*moved)
    knots = torch.arange(41, dtype=torch.float64)
    is_known = track[:, 0] < NOWHERE
    shares = torch.exp(-0.5 * ((knots[:, None] - knots) / LEARNT_WITH) ** 2) * is_known * is_known[:, None]
    shares = shares / shares.sum(1, keepdim=True).clamp(min=1)
    torch.testing.assert_close(gradients[1][0], shares.T @ gradients[0][0])
    assert (gradients[1][0][30:33] == 0).all()
    assert (gradients[1][0][is_known] != 0).any(-1).all()


def test_none_is_carried_until_one_is_added_and_weights_know_them(tmp_path: object) -> None:
    bodies = CarriedBodies(3, 11)
    positions, times = torch.randn(50, 3), torch.rand(50)
    assert torch.equal(bodies(positions, times), positions)
    bodies.add(tracks()[0].float(), HOMES[0].float(), 0.3)
    bodies.set_searched()
    path = tmp_path / "weights.safetensors"  # type: ignore[operator]
    save_weights(bodies, path)
    other = CarriedBodies(3, 11)
    assert not other.was_searched
    load_weights(other, path)
    assert (other.num_bodies, other.was_searched) == (1, True)
    assert torch.equal(other(positions, times), bodies(positions, times))


def test_what_cannot_be_carried() -> None:
    bodies = CarriedBodies(1, 11)
    track, home = tracks()[0].float(), HOMES[0].float()
    with pytest.raises(ValueError, match=r"home must be 0.6 away from the track, got 0.5"):
        bodies.add(track, track[5] + torch.tensor([0.0, 0.0, 0.5]), 0.3)
    with pytest.raises(ValueError, match="track must have shape"):
        bodies.add(track[:5], home, 0.3)
    with pytest.raises(ValueError, match="radius"):
        bodies.add(track, home, 0.0)
    assert bodies.num_bodies == 0
    bodies.add(track, home, 0.3)
    with pytest.raises(ValueError, match="room for max_bodies = 1"):
        bodies.add(track, home, 0.3)
    with pytest.raises(ValueError, match="num_knots must be at least 4, got 1"):
        CarriedBodies(1, 1)
    with pytest.raises(ValueError, match="max_bodies"):
        CarriedBodies(0)


@pytest.mark.parametrize(
    ("track", "home", "expected"),
    [
        (tracks()[1], HOMES[0], "home must be 0.5 away from home 0, got 0"),
        (tracks()[1], tracks()[0][5], "home must be 0.5 away from track 0, got 0"),
        (HOMES[0].expand(11, 3), HOMES[1], "track must be 0.5 away from home 0, got 0"),
    ],
)
def test_homes_meet_no_other_body(track: Tensor, home: Tensor, expected: str) -> None:
    bodies = CarriedBodies(3, 11).double()
    bodies.add(tracks()[0], HOMES[0], 0.3)
    with pytest.raises(ValueError, match=expected):
        bodies.add(track, home, 0.2)
    assert bodies.num_bodies == 1


def test_home_of_an_absent_body_holds_no_matter_that_moves() -> None:
    bodies = CarriedBodies(1, 11)
    track = tracks()[0].float()
    track[:4] = NOWHERE
    bodies.add(track, HOMES[0].float(), 0.3)
    points = torch.stack([HOMES[0].float(), torch.zeros(3)])
    moved, residual = carry(CarriedDeformation(bodies, IdentityDeformation()), points, 0.1, 0.1)
    assert torch.equal(moved, points)
    assert residual.tolist() == [math.inf, 0.0]


@pytest.mark.parametrize("inner", [IdentityDeformation(), DisplacementDeformation(2, 16, ())])
def test_points_of_a_body_are_carried_along_its_track(inner: torch.nn.Module) -> None:
    """With an invertible deformation behind it and with another one, which is at rest as it begins."""
    bodies = CarriedBodies(1, 11)
    bodies.add(tracks()[0].float(), HOMES[0].float(), 0.3)
    motion = CarriedDeformation(bodies, inner)
    offsets = 0.15 * torch.randn(20, 3).clamp(-1, 1)
    moved, residual = carry(motion, bodies.centers(0, torch.zeros(20)) + offsets, 0.0, 0.7)
    torch.testing.assert_close(moved, bodies.centers(0, torch.full((20,), 0.7)) + offsets, rtol=0, atol=2e-3)
    assert float(residual.amax()) < 1e-3
    still = torch.tensor([[0.0, 0.0, 0.9]])
    torch.testing.assert_close(carry(motion, still, 0.0, 0.7)[0], still, rtol=0, atol=2e-3)
    times = torch.linspace(0, 1, 5)
    followed = follow(motion, bodies.centers(0, times[:1]), 0.0, times)
    torch.testing.assert_close(followed.positions[:, 0], bodies.centers(0, times), rtol=0, atol=2e-3)
