"""What every velocity field must do: nothing at first and at the faces of its box, and smoothly between."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from dnerf.deformations.velocities import BoxWindow, NetworkVelocity, Velocity, smooth_step_coefficients

BOX = ((-1.0, -2.0, -1.5), (1.0, 2.0, 0.5))
VELOCITIES: dict[str, Callable[[], Velocity]] = {
    "network": lambda: NetworkVelocity(BOX, 2, 16),
    "network, relu": lambda: NetworkVelocity(BOX, 1, 16, activation="relu", smoothness=1),
}
every_velocity = pytest.mark.parametrize("name", VELOCITIES)


def trained(name: str, dtype: torch.dtype = torch.float64) -> Velocity:
    velocity = VELOCITIES[name]().to(dtype)
    with torch.no_grad():
        for parameter in velocity.parameters():
            parameter += 0.2 * torch.randn_like(parameter)
    return velocity


def points(count: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    low, high = torch.tensor(BOX, dtype=dtype)
    return torch.lerp(low, high, torch.rand(count, 3, dtype=dtype)), torch.rand(count, dtype=dtype)


@every_velocity
def test_nothing_moves_at_initialisation(name: str) -> None:
    assert torch.count_nonzero(VELOCITIES[name]()(*points(50, torch.float32))) == 0


@every_velocity
def test_nothing_moves_on_the_faces_and_outside(name: str) -> None:
    positions, times = points(60)
    low, high = torch.tensor(BOX, dtype=torch.float64)
    velocity = trained(name)
    assert torch.count_nonzero(velocity(positions, times).abs().sum(-1)) > 30
    for axis in range(3):
        for face in (low[axis], high[axis], low[axis] - 1, high[axis] + 100):
            moved = positions.clone()
            moved[:, axis] = face
            assert torch.count_nonzero(velocity(moved, times)) == 0


@every_velocity
@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
def test_shape_and_dtype_are_those_of_positions(name: str, batch: tuple[int, ...]) -> None:
    for dtype in (torch.float32, torch.float64):
        velocity = trained(name, dtype)
        value = velocity(torch.zeros(*batch, 3, dtype=dtype), torch.zeros(batch, dtype=dtype))
        assert value.shape == (*batch, 3)
        assert value.dtype == dtype


@every_velocity
def test_fixed_times_give_the_same_field(name: str) -> None:
    velocity = trained(name)
    positions, times = points(20)
    field = velocity.at(times)
    assert torch.equal(field(positions), velocity(positions, times))
    assert torch.equal(field(0.5 * positions), velocity(0.5 * positions, times))


@every_velocity
def test_times_beyond_the_film_are_finite(name: str) -> None:
    velocity = trained(name)
    positions, times = points(20)
    assert torch.isfinite(velocity(positions, times + 1)).all()
    assert torch.isfinite(velocity(positions, times - 1)).all()


@every_velocity
def test_no_value_is_read(name: str) -> None:
    """Nor in the backward pass, which a dispatch mode would divert: CUDA graphs could not record it."""
    velocity = trained(name)
    positions, times = points(4)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        velocity(positions.requires_grad_(), times.requires_grad_()).square().sum().backward()
    assert not {"aten::item", "aten::nonzero"} & {event.name for event in profile.events()}


def test_gradcheck() -> None:
    velocity = trained("network")
    positions, times = points(3)
    assert torch.autograd.gradcheck(velocity, (positions.requires_grad_(), times.requires_grad_()))


@pytest.mark.parametrize("smoothness", range(5))
def test_window_is_a_smooth_step_of_its_order(smoothness: int) -> None:
    window = BoxWindow(BOX, 0.25, smoothness).double()
    fade = 0.25
    line = torch.linspace(1 - fade - 0.01, 1.01, 300, dtype=torch.float64, requires_grad=True)
    centre = window.center.double()
    positions = torch.stack([line, centre[1].expand_as(line), centre[2].expand_as(line)], dim=-1)
    value = window(positions)[:, 0]
    assert torch.all(value.diff() <= 0)
    assert value[0] == 1
    assert value[-1] == 0
    # The Beta integral that the polynomial is, from its definition.
    u = ((1 - line.detach()) / fade).clamp(0, 1)
    n = smoothness
    grid = torch.linspace(0, 1, 20001, dtype=torch.float64)
    density = (grid * (1 - grid)) ** n
    integral = torch.cumulative_trapezoid(density, grid)
    exact = torch.cat([torch.zeros(1), integral]) / integral[-1]
    found = exact[(u * 20000).round().long()]
    torch.testing.assert_close(value.detach(), found, rtol=0, atol=1e-3)
    derivative = value
    for _ in range(smoothness):
        (derivative,) = torch.autograd.grad(derivative.sum(), line, create_graph=True)
        # Zero at both ends of the fading layer: no jump to what is constant beyond.
        assert derivative[line > 1].abs().max() == 0
        edge = derivative[(line - (1 - fade)).abs().argmin()].abs()
        assert edge <= 0.2 * derivative.abs().max()


def test_smooth_step_coefficients_are_the_known_ones() -> None:
    assert smooth_step_coefficients(0) == [1]
    assert smooth_step_coefficients(1) == [3, -2]
    assert smooth_step_coefficients(2) == [10, -15, 6]
    assert smooth_step_coefficients(4) == [126, -420, 540, -315, 70]


@pytest.mark.parametrize(("make", "message"), [
    (lambda: BoxWindow(BOX, 0.0), "fade must be > 0"), (lambda: BoxWindow(BOX, 1.5), r"fade must be in \(0, 1\]"),
    (lambda: BoxWindow(BOX, 0.5, 5), r"smoothness in 0\.\.4"),
    (lambda: NetworkVelocity(BOX, 0), "num_layers must be > 0"),
    (lambda: NetworkVelocity(BOX, activation="sine"), "activation must be one of relu, silu, softplus"),
])  # fmt: skip
def test_bad_settings_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
