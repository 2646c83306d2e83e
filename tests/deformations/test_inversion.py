"""The fixed-point inverse: exact where there is one, honest where there is none."""

import itertools

import pytest
import torch
from torch import Tensor

from benchmarks.closed_flows import Swirl
from dnerf.deformations import DisplacementDeformation, FlowDeformation, invert
from dnerf.deformations.inversion import attach_gradient


def points(count: int) -> tuple[Tensor, Tensor]:
    return torch.rand(count, 3, dtype=torch.float64) * 2 - 1, torch.rand(count, dtype=torch.float64)


def gentle_displacement() -> DisplacementDeformation:
    deformation = DisplacementDeformation(2, 32, (), position_frequencies=1, canonical_time=None).double()
    torch.nn.init.normal_(deformation.mlp.output.weight, std=0.05)
    return deformation


def test_inverse_of_a_gentle_displacement_is_found() -> None:
    deformation = gentle_displacement()
    world, times = points(500)
    canonical = deformation(world, times)
    assert (canonical - world).norm(dim=-1).mean() > 0.1
    found, residual = invert(deformation, canonical, times)
    assert residual.max() < 1e-10
    torch.testing.assert_close(found, world, rtol=0, atol=1e-9)


def test_inverse_of_a_swirl_is_its_closed_form() -> None:
    flow = FlowDeformation(Swirl(0.5), 0.0, num_steps=64)
    canonical, times = points(200)
    found, residual = invert(flow, canonical, times, num_iterations=60)
    torch.testing.assert_close(found, flow.velocity.carry(canonical, 0 * times, times), rtol=0, atol=1e-6)
    assert residual.max() < 1e-6


def test_residual_is_the_distance_that_is_left() -> None:
    deformation = gentle_displacement()
    canonical, times = points(50)
    found, residual = invert(deformation, canonical, times, num_iterations=3)
    torch.testing.assert_close(residual, (deformation(found, times) - canonical).norm(dim=-1))
    assert residual.max() > 1e-8


def test_more_iterations_never_make_it_worse() -> None:
    deformation = DisplacementDeformation(2, 32, (), canonical_time=None).double()
    torch.nn.init.normal_(deformation.mlp.output.weight, std=0.5)  # folds
    canonical, times = points(200)
    residuals = [invert(deformation, canonical, times, num_iterations=n)[1] for n in (1, 5, 20, 40)]
    for before, after in itertools.pairwise(residuals):
        assert (after <= before).all()


def test_a_place_that_nothing_maps_to_has_a_residual() -> None:
    def flatten(positions: Tensor, times: Tensor) -> Tensor:
        return positions * torch.tensor([1.0, 1.0, 0.0], dtype=positions.dtype)

    canonical = torch.tensor([[0.3, 0.2, 0.1]], dtype=torch.float64)
    found, residual = invert(flatten, canonical, torch.zeros(1))
    assert torch.isfinite(found).all()
    assert residual.item() == pytest.approx(0.1, abs=1e-9)


def test_a_guess_chooses_among_several_answers() -> None:
    def fold(positions: Tensor, times: Tensor) -> Tensor:
        return torch.cat([positions[..., :1].square(), positions[..., 1:]], dim=-1)

    canonical, times = torch.tensor([[0.25, 0.0, 0.0]], dtype=torch.float64), torch.zeros(1)
    for root in (0.5, -0.5):
        guess = torch.tensor([[root * 1.2, 0.0, 0.0]], dtype=torch.float64)
        found, residual = invert(fold, canonical, times, guess=guess)
        assert residual.max() < 1e-9
        assert found[0, 0].item() == pytest.approx(root, abs=1e-8)


def test_attached_gradient_is_that_of_the_inverse() -> None:
    deformation = gentle_displacement()
    world, times = points(3)
    canonical = deformation(world, times).detach()

    def solved(canonical: Tensor, weight: Tensor) -> Tensor:
        with torch.no_grad():
            deformation.mlp.output.weight.copy_(weight)
        found = invert(deformation, canonical.detach(), times)[0]
        return attach_gradient(deformation, found, canonical, times)

    canonical.requires_grad_()
    weight = deformation.mlp.output.weight.detach().clone()
    result = solved(canonical, weight)
    (to_canonical,) = torch.autograd.grad(result.sum(), canonical, retain_graph=True)
    (to_weight,) = torch.autograd.grad(result.sum(), deformation.mlp.output.weight)
    step = 1e-5
    direction = torch.randn_like(weight)
    slope = (solved(canonical, weight + step * direction) - solved(canonical, weight - step * direction)).sum()
    assert slope.item() / (2 * step) == pytest.approx(float((to_weight * direction).sum()), rel=1e-4)
    shift = torch.randn_like(canonical)
    slope = (solved(canonical + step * shift, weight) - solved(canonical - step * shift, weight)).sum()
    assert slope.item() / (2 * step) == pytest.approx(float((to_canonical * shift).sum()), rel=1e-4)


@pytest.mark.parametrize(("arguments", "message"), [
    ({"num_iterations": 0}, "num_iterations must be > 0"),
    ({"guess": torch.zeros(3, 3)}, r"guess must have shape \(4, 3\), got \(3, 3\)"),
])  # fmt: skip
def test_bad_arguments_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        invert(gentle_displacement(), torch.zeros(4, 3).double(), torch.zeros(4).double(), **arguments)


def test_half_precision_is_solved_in_single() -> None:
    """To the rounding of positions of up to 1.5 in bfloat16, 2^-8, a few times."""
    deformation = gentle_displacement().float()
    positions, times = (x.float() for x in points(200))
    canonical = deformation(positions, times)
    with torch.autocast("cpu", enabled=False):
        half = gentle_displacement().bfloat16()
        half.load_state_dict({name: value.bfloat16() for name, value in deformation.state_dict().items()})
        target, at = canonical.bfloat16(), times.bfloat16()
        for use_jacobian in (False, True):
            found, residual = invert(half, target, at, use_jacobian=use_jacobian)
            assert residual.float().median() < 0.01
            solved = attach_gradient(half, found, target, at).detach()
            assert solved.dtype == torch.bfloat16
            assert float((solved.float() - positions).norm(dim=-1).median()) < 0.04
