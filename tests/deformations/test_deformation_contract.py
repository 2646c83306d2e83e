"""What every deformation must do. A new one is one line in `DEFORMATIONS`."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from dnerf.deformations import (
    CachedDeformation,
    Deformation,
    DisplacementDeformation,
    FlowChain,
    FlowDeformation,
    IdentityDeformation,
    InvertibleDeformation,
    SE3Deformation,
)
from dnerf.deformations.velocities import NetworkVelocity

BOX = ((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0))


def network_velocity() -> NetworkVelocity:
    return NetworkVelocity(BOX, 2, 16, position_frequencies=1, time_frequencies=2)


def small_displacement() -> DisplacementDeformation:
    return DisplacementDeformation(2, 16, (), position_frequencies=2, time_frequencies=2)


# Small networks: the contract does not depend on the width.
DEFORMATIONS: dict[str, Callable[[], Deformation]] = {
    "identity": IdentityDeformation,
    "displacement": lambda: DisplacementDeformation(3, 16, (1,), position_frequencies=4, time_frequencies=3),
    "displacement, no canonical time": lambda: DisplacementDeformation(2, 16, (), canonical_time=None),
    "displacement, canonical time 0.5": lambda: DisplacementDeformation(2, 16, (), canonical_time=0.5),
    "displacement, windowed": lambda: DisplacementDeformation(2, 16, (), window_end=0.5),
    "displacement, time embeddings": lambda: DisplacementDeformation(2, 16, (), time_embeddings=5),
    "se3": lambda: SE3Deformation(2, 16, (), position_frequencies=2, canonical_time=None),
    "se3, canonical time": lambda: SE3Deformation(2, 16, (), position_frequencies=2),
    "flow": lambda: FlowDeformation(network_velocity(), 0.5),
    "flow, stationary velocity": lambda: FlowDeformation(
        network_velocity(), None, velocity_in_time="stationary", solver="midpoint", num_steps=1
    ),
    "flow, time embeddings": lambda: FlowDeformation(NetworkVelocity(BOX, 2, 16, time_embeddings=5), num_steps=4),
    "flows in a row": lambda: FlowChain(
        {
            name: FlowDeformation(network_velocity(), None, velocity_in_time="stationary", solver="euler", num_steps=1)
            for name in ("first", "second")
        }
    ),
    "cached": lambda: CachedDeformation(small_displacement(), BOX),
}
INVERTIBLE = [name for name, make in DEFORMATIONS.items() if isinstance(make(), InvertibleDeformation)]
TRAINABLE = [name for name, make in DEFORMATIONS.items() if list(make().parameters())]

every_deformation = pytest.mark.parametrize("name", DEFORMATIONS)


def trained(name: str, dtype: torch.dtype = torch.float64) -> Deformation:
    """A deformation away from its initialisation, as training would leave it."""
    deformation = DEFORMATIONS[name]().to(dtype)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in deformation.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator, dtype=dtype)
    return deformation


def some_points(*batch: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(4)
    positions = torch.randn((*batch, 3), generator=generator, dtype=dtype)
    return positions, torch.rand(batch, generator=generator, dtype=dtype)


@every_deformation
@pytest.mark.parametrize("batch", [(), (7,), (2, 5), (0,), (3, 0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_canonical_positions_have_the_shape_and_dtype_of_positions(
    name: str, batch: tuple[int, ...], dtype: torch.dtype
) -> None:
    positions, times = some_points(*batch, dtype=dtype)
    canonical = trained(name, dtype)(positions, times)
    assert canonical.shape == positions.shape
    assert canonical.dtype == dtype


@every_deformation
def test_initial_deformation_is_the_identity(name: str) -> None:
    positions, times = some_points(50, dtype=torch.float32)
    for t in (times, torch.zeros_like(times), torch.ones_like(times)):
        assert torch.equal(DEFORMATIONS[name]()(positions, t), positions)


@every_deformation
def test_mixed_times_equal_one_time_after_the_other(name: str) -> None:
    deformation = trained(name)
    positions, times = some_points(9)
    times[0], times[1] = 0, 1
    together = deformation(positions, times)
    for i in range(9):
        alone = deformation(positions[i], times[i])
        # Matrix products of other sizes round differently.
        torch.testing.assert_close(together[i], alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", TRAINABLE)
def test_a_trained_deformation_moves_with_time(name: str) -> None:
    positions, times = some_points(20)
    deformation = trained(name)
    assert not torch.equal(deformation(positions, times), deformation(positions, 1 - times))


@pytest.mark.parametrize("name", TRAINABLE)
def test_gradients_reach_parameters_at_initialisation(name: str) -> None:
    deformation = DEFORMATIONS[name]()
    positions, times = some_points(20, dtype=torch.float32)
    deformation(positions, times).square().sum().backward()
    gradients = [p.grad for p in deformation.parameters() if p.grad is not None]
    assert any(torch.count_nonzero(gradient) for gradient in gradients)
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


@pytest.mark.parametrize("name", TRAINABLE)
def test_gradients_reach_every_parameter_after_the_first_step(name: str) -> None:
    deformation = trained(name)
    for module in deformation.modules():
        if hasattr(module, "set_progress"):
            module.set_progress(1.0)
    positions, times = some_points(200)
    deformation(positions, times).square().sum().backward()
    for parameter in deformation.parameters():
        assert parameter.grad is not None
        assert torch.isfinite(parameter.grad).all()
        assert torch.count_nonzero(parameter.grad) > 0


@every_deformation
def test_gradcheck_to_positions_and_times(name: str) -> None:
    positions, times = some_points(4)
    deformation = trained(name)

    def scaled(positions: Tensor, times: Tensor) -> Tensor:
        # Slow waves: finite differences need a smooth function.
        return deformation(0.01 * positions, 0.01 * times) + 0 * times[..., None]

    assert torch.autograd.gradcheck(scaled, (positions.requires_grad_(), times.requires_grad_()), atol=1e-4)


@every_deformation
def test_deformation_is_deterministic(name: str) -> None:
    deformation = trained(name)
    positions, times = some_points(30)
    first = deformation(positions, times)
    deformation.eval()
    assert torch.equal(first, deformation(positions, times))


@every_deformation
def test_positions_are_not_changed_in_place(name: str) -> None:
    positions, times = some_points(5)
    before = positions.clone(), times.clone()
    trained(name)(positions, times)
    assert torch.equal(positions, before[0])
    assert torch.equal(times, before[1])


@every_deformation
@pytest.mark.parametrize("shape", [(4, 1), (), (1,), (5,), (4, 3)])
def test_times_of_another_shape_are_named(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError) as error:
        DEFORMATIONS[name]()(torch.zeros(4, 3), torch.zeros(shape))
    assert str(error.value) == f"times must have shape (4,), got {shape}"


@every_deformation
def test_positions_of_another_shape_are_named(name: str) -> None:
    with pytest.raises(ValueError) as error:
        DEFORMATIONS[name]()(torch.zeros(4, 2), torch.zeros(4))
    assert str(error.value) == "positions must have shape (..., 3), got (4, 2)"


@every_deformation
def test_bfloat16_autocast_keeps_positions_precise(name: str) -> None:
    deformation = trained(name, torch.float32)
    positions, times = some_points(50, dtype=torch.float32)
    if not name.startswith("se3"):  # whose turns about the origin are as uncertain as their angles times the arm
        positions = positions + 100
    exact = deformation(positions, times)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        canonical = deformation(positions, times)
    assert canonical.dtype == torch.float32
    # Offsets lose digits to bfloat16 (2^-8, a few layers), positions of size 100 must not.
    scale = (exact - positions).abs().max().item()
    torch.testing.assert_close(canonical, exact, rtol=0, atol=0.05 * scale + 1e-5)


@pytest.mark.parametrize("name", INVERTIBLE)
def test_round_trip_through_the_canonical_space(name: str) -> None:
    deformation = trained(name)
    assert isinstance(deformation, InvertibleDeformation)
    positions, times = some_points(50)
    there_and_back = deformation.inverse(deformation(positions, times), times)
    torch.testing.assert_close(there_and_back, positions, rtol=0, atol=1e-6)
    back_and_there = deformation(deformation.inverse(positions, times), times)
    torch.testing.assert_close(back_and_there, positions, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", INVERTIBLE)
def test_inverse_names_times_of_another_shape(name: str) -> None:
    deformation = DEFORMATIONS[name]()
    assert isinstance(deformation, InvertibleDeformation)
    with pytest.raises(ValueError, match=r"times must have shape \(4,\), got \(4, 1\)"):
        deformation.inverse(torch.zeros(4, 3), torch.zeros(4, 1))
