"""Flows at their hard cases: full turns, long ways, stiff and expanding fields, no way at all, any finite point."""

import copy

import pytest
import torch
from cases import relative, value_and_gradients
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from benchmarks.closed_flows import ClosedFlow, Expansion, Rotation, Shear, Swirl
from dnerf.deformations import FlowDeformation
from dnerf.deformations.velocities import NetworkVelocity

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
TURN = 6.283185307179586

HARD: dict[str, tuple[ClosedFlow, int, float, float]] = {
    # velocity, RK4 steps, bound of the method's own error, and of float32: 6e-8 a step, or its square root's growth
    "no motion": (Rotation(0.0), 1, 0.0, 1e-6),
    "a full turn": (Rotation(TURN), 64, 2e-5, 3e-6),
    "ten turns": (Rotation(10 * TURN), 640, 2e-4, 3e-5),
    "to and fro fifty times": (Shear(2.0, 50 * TURN), 640, 1e-4, 1e-5),
    "a swirl of several turns": (Swirl(10.0, 1.0), 640, 1e-3, 1e-4),
    "three thousand times as large": (Expansion(8.0), 64, 1e-4, 1e-5),
    "stiff: shrinks to nothing": (Expansion(-50.0), 64, 1e-1, 1e-6),
}


def points(count: int = 500) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    times = torch.rand(count, generator=generator)
    times[:2] = torch.tensor([0.0, 1.0])
    return 2 * torch.rand(count, 3, generator=generator) - 1, times


def moving() -> NetworkVelocity:
    """A velocity field that moves points by some tenths: parameters that are zero as it starts become random."""
    velocity = NetworkVelocity(BOX, 3, 32)
    for parameter in velocity.parameters():
        if not parameter.detach().any():
            nn.init.normal_(parameter, std=0.1)
    return velocity


def scale(exact: Tensor) -> float:
    return max(1.0, float(exact.abs().max()))


@pytest.mark.parametrize("name", HARD)
def test_float32_follows_float64_and_the_closed_form_in_value_and_gradient(name: str) -> None:
    velocity, steps, of_method, of_float32 = HARD[name]
    flow = FlowDeformation(velocity, solver="rk4", num_steps=steps)
    positions, times = points()
    rounded, gradients = value_and_gradients(flow, positions, times)
    exact, truths = value_and_gradients(flow, positions.double(), times.double())
    closed, closed_gradients = value_and_gradients(
        lambda x, t: velocity.carry(x, t, torch.zeros_like(t)), positions.double(), times.double()
    )
    # Times are known to 6e-8 too: their gradient is a speed, up to 63 units for ten turns, and is relative to its own.
    for a, b, c in zip((rounded, *gradients), (exact, *truths), (closed, *closed_gradients)):
        assert torch.isfinite(a).all()
        assert (a.double() - b).abs().max() / scale(b) <= of_float32 * (50 if a.ndim == 1 else 1)
        assert (b - c).abs().max() / scale(c) <= of_method * (50 if a.ndim == 1 else 1) + 1e-12


@pytest.mark.parametrize("solver", ["euler", "midpoint", "rk4", "dopri5"])
def test_a_way_of_no_length_is_the_identity_in_every_precision(solver: str) -> None:
    flow = FlowDeformation(moving(), 0.25, solver=solver)
    positions, times = points(60)
    times = torch.full_like(times, 0.25)
    for dtype in (torch.float32, torch.float64):
        value, (gradient,) = value_and_gradients(lambda x: flow.to(x.dtype)(x, times.to(x.dtype)), positions.to(dtype))
        assert torch.equal(value, positions.to(dtype))
        assert torch.equal(gradient, torch.ones_like(gradient))
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(flow.float()(positions, times), positions)


def test_trainable_flows_in_float32_agree_with_float64() -> None:
    flow = FlowDeformation(moving(), 0.5, solver="midpoint", num_steps=4)
    truth = copy.deepcopy(flow).double()
    positions, times = points()
    rounded, (gradient,) = value_and_gradients(lambda x: flow(x, times), positions)
    exact, (exact_gradient,) = value_and_gradients(lambda x: truth(x, times.double()), positions.double())
    assert (exact - positions).norm(dim=-1).max() > 1e-3
    # A few roundings a step, magnified by encodings (up to 2^5).
    assert (rounded.double() - exact).abs().max() < 2e-5
    # Nearly all slopes agree, none is wild.
    assert (gradient.double() - exact_gradient).abs().quantile(0.98) < 1e-3
    assert torch.isfinite(gradient).all()


@given(seed=st.integers(0, 2**31), size=st.sampled_from([0.0, 1e-45, 1e-38, 1e-6, 1.0, 1.5, 1e3, 1e18, 3.4e38]))
def test_no_finite_point_makes_a_nan_or_an_infinity(seed: int, size: float) -> None:
    # Fifty examples of 200 points: ten thousand, up to the largest float32 there is.
    generator = torch.Generator().manual_seed(seed)
    positions = size * (2 * torch.rand(200, 3, generator=generator) - 1)
    times = torch.rand(200, generator=generator)
    torch.manual_seed(seed)
    flow = FlowDeformation(moving(), 0.5, solver="midpoint", num_steps=2)
    value, gradients = value_and_gradients(flow, positions, times)
    for result in (value, *gradients):
        assert torch.isfinite(result).all()
    outside = (positions.abs() >= 1.5).any(-1)
    assert torch.equal(value[outside], positions[outside])


def test_expansion_is_relative_to_where_a_point_goes() -> None:
    velocity = Expansion(8.0)
    positions = 10 ** (-12 + 12 * torch.rand(2000, 3))
    ones = torch.ones(2000)
    flow = FlowDeformation(velocity, solver="rk4", num_steps=128)
    back = flow.reverse(positions, ones)
    exact = flow.reverse(positions.double(), ones.double())
    assert relative(back, exact).max() < 2e-5  # 128 steps, a rounding or two each
