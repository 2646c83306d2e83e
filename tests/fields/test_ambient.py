"""Ambient coordinates: nothing without them, nothing at the start, and what only they can say."""

import pytest
import torch
from torch import Tensor

from dnerf.fields import AmbientCoordinates, GridField

BOX = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]


def grid(ambient: AmbientCoordinates | None) -> GridField:
    return GridField(BOX, (4, 8), 2, hidden_features=16, temporal_terms=2, window_end=0.5, space_time=ambient)


def some_points(count: int = 60) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    positions = 2 * torch.rand(count, 3, generator=generator) - 1
    return positions, torch.nn.functional.normalize(positions, dim=-1), torch.rand(count, generator=generator)


def test_without_coordinates_it_is_the_field_without() -> None:
    without, field = grid(None), grid(AmbientCoordinates(0))
    field.load_state_dict(without.state_dict())  # no parameter more
    expected, found = without(*some_points()), field(*some_points())
    assert torch.equal(found.density, expected.density)
    assert torch.equal(found.rgb, expected.rgb)
    assert not list(AmbientCoordinates(0).parameters())


def test_a_fresh_field_is_as_without_and_learns() -> None:
    """The head's other weights are the same; those of the new columns see zeros."""
    without, field = grid(None), grid(AmbientCoordinates(2))
    state, wider, first = without.state_dict(), field.state_dict(), "head.hidden.0.weight"
    state[first] = torch.cat([state[first], wider[first][:, state[first].shape[1] :]], dim=1)
    field.load_state_dict({**wider, **state})
    assert not field.space_time(*some_points()[::2]).any()
    expected, found = without(*some_points()), field(*some_points())
    torch.testing.assert_close(found.density, expected.density, rtol=1e-5, atol=0)
    torch.testing.assert_close(found.rgb, expected.rgb, rtol=0, atol=1e-6)
    (found.density.sum() + found.rgb.sum()).backward()
    assert field.space_time.slicing.output.weight.grad.abs().sum() > 0


def test_features_are_the_coordinates_and_their_windowed_waves() -> None:
    ambient = AmbientCoordinates(2, ambient_frequencies=2, window_end=0.5).double()
    torch.nn.init.normal_(ambient.slicing.output.weight)
    places, _, times = (x.double() for x in some_points())
    w = ambient(places, times)[:, :2]
    assert w.std() > 0.1
    assert not torch.equal(w, ambient(places, 1 - times)[:, :2])
    angles = torch.cat([w, 2 * w], dim=-1)
    for progress, shares in ((0.0, (0, 0)), (0.25, (1, 0)), (0.5, (1, 1))):
        ambient.encode.set_progress(progress)
        weights = torch.tensor(shares, dtype=torch.float64).repeat_interleave(2)
        expected = torch.cat([w, torch.sin(angles) * weights, torch.cos(angles) * weights], dim=-1)
        torch.testing.assert_close(ambient(places, times), expected, rtol=1e-12, atol=1e-12)


def test_what_vanishes_is_learnt_where_nothing_else_in_the_field_sees_time() -> None:
    """A ball that is there in the first half alone: no one density over space shows it, one over (x, w) does."""
    torch.manual_seed(0)
    field = GridField(BOX, (4,), 2, hidden_features=16, space_time=AmbientCoordinates(1, hidden_features=16))
    optimizer = torch.optim.Adam(field.parameters(), 0.02)
    for _ in range(150):
        places, times = 2 * torch.rand(256, 3) - 1, torch.rand(256)
        target = ((places.norm(dim=-1) < 0.7) & (times < 0.5)).float()
        loss = (1 - torch.exp(-field.density(places, times)) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    early, late = field.density(torch.zeros(2, 3), torch.tensor([0.2, 0.8])).tolist()
    assert early > 1
    assert late < 0.2


def test_bad_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="num_coordinates must be"):
        AmbientCoordinates(-1)
    with pytest.raises(ValueError, match="times must have shape"):
        AmbientCoordinates(2)(torch.zeros(4, 3), torch.zeros(3))
