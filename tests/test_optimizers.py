"""Adam with orthogonalised momentum for matrices."""

import copy

import pytest
import torch

from dnerf.optimizers import AdamMuon, moments_of, orthogonalized


def parameters(*shapes: tuple[int, ...]) -> list[torch.nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [torch.nn.Parameter(torch.randn(shape, generator=generator)) for shape in shapes]


@pytest.mark.parametrize("shape", [(2, 16, 16), (3, 64, 24), (1, 24, 128)])
def test_singular_values_become_nearly_one(shape: tuple[int, ...]) -> None:
    matrices = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    values = torch.linalg.svdvals(orthogonalized(matrices))
    # Five rounds of the quintic; bfloat16 rounds each product by 2^-8.
    assert values.min() > 0.5
    assert values.max() < 1.3


def test_it_turns_nothing() -> None:
    """The result has the singular vectors of the matrix: its product with the polar factor is symmetric."""
    matrix = torch.randn(1, 32, 32, generator=torch.Generator().manual_seed(2))
    u, _, vh = torch.linalg.svd(matrix)
    product = orthogonalized(matrix) @ (u @ vh).mT
    assert (product - product.mT).abs().max() < 0.05  # bfloat16
    assert torch.linalg.eigvalsh(0.5 * (product + product.mT)).min() > 0.5


def test_size_and_sign_do_not_matter_and_zeros_stay() -> None:
    matrix = torch.randn(1, 16, 20, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(orthogonalized(1024 * matrix), orthogonalized(matrix))
    torch.testing.assert_close(orthogonalized(-matrix), -orthogonalized(matrix))
    assert not orthogonalized(torch.zeros(1, 16, 20)).any()
    assert orthogonalized(matrix * 1e-30).isfinite().all()


def test_other_groups_take_the_very_steps_of_adam() -> None:
    plain, mixed = parameters((5, 3), (7,)), parameters((5, 3), (7,))
    matrix = parameters((16, 16))
    adam = torch.optim.Adam(plain, lr=0.1, betas=(0.8, 0.9))
    both = AdamMuon([{"params": mixed}, {"params": matrix, "orthogonal": True}], lr=0.1, betas=(0.8, 0.9))
    for step in range(4):
        for p in (*plain, *mixed, *matrix):
            p.grad = torch.full_like(p, step + 1.0)
        adam.step()
        both.step()
        assert matrix[0].grad is not None
    for a, b in zip(plain, mixed, strict=True):
        assert torch.equal(a, b)


def test_steps_have_the_size_of_adams() -> None:
    (matrix,) = parameters((48, 24))
    before = matrix.detach().clone()
    optimizer = AdamMuon([{"params": [matrix], "orthogonal": True}], lr=0.01)
    matrix.grad = torch.randn(48, 24, generator=torch.Generator().manual_seed(4))
    optimizer.step()
    root_mean_square = (matrix.detach() - before).square().mean().sqrt()
    assert 0.6 < root_mean_square / (0.01 * 0.2) < 1.3  # the range of the singular values


def test_it_solves_a_badly_scaled_problem_that_holds_adam_up() -> None:
    """Least squares of a matrix whose inputs differ in scale by 10^3: Adam's step per entry follows the rotation."""
    generator = torch.Generator().manual_seed(5)
    rotation = torch.linalg.qr(torch.randn(32, 32, generator=generator))[0]
    inputs = torch.randn(512, 32, generator=generator) * torch.logspace(0, -3, 32) @ rotation
    wanted = torch.randn(32, 32, generator=generator) * 0.1
    errors = {}
    for orthogonal in (False, True):
        weight = torch.nn.Parameter(torch.zeros(32, 32))
        optimizer = AdamMuon([{"params": [weight], "orthogonal": orthogonal}], lr=0.02)
        for step in range(200):
            optimizer.param_groups[0]["lr"] = 0.02 * (1 - step / 200)
            optimizer.zero_grad()
            (inputs @ (weight - wanted)).square().mean().backward()
            optimizer.step()
        errors[orthogonal] = float((weight.detach() - wanted).square().mean())
    assert errors[True] < 0.5 * errors[False]


def test_state_survives_saving_and_loading() -> None:
    def run(steps: int, state: dict | None = None, start: torch.Tensor | None = None) -> tuple[torch.Tensor, dict]:
        (matrix,) = parameters((16, 16))
        if start is not None:
            matrix.data.copy_(start)
        optimizer = AdamMuon([{"params": [matrix], "orthogonal": True}], lr=0.1)
        if state is not None:
            optimizer.load_state_dict(state)
        for _ in range(steps):
            optimizer.zero_grad()
            (matrix @ matrix.mT).square().sum().backward()
            optimizer.step()
        assert optimizer.state[matrix].keys() == moments_of(optimizer, matrix)
        return matrix.detach().clone(), copy.deepcopy(optimizer.state_dict())

    straight, _ = run(6)
    half, state = run(3)
    assert torch.equal(run(3, state, half)[0], straight)


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match=r"matrices, got shape \(3,\)"):
        AdamMuon([{"params": parameters((3,)), "orthogonal": True}])
    with pytest.raises(ValueError, match="momentum must be in"):
        AdamMuon([{"params": parameters((3, 3))}], momentum=1.0)
    with pytest.raises(ValueError, match="one of the optimiser's"):
        moments_of(AdamMuon([{"params": parameters((3, 3))}]), torch.nn.Parameter(torch.zeros(2)))


@pytest.mark.gpu
def test_rates_on_the_device_take_the_same_steps() -> None:
    """As CUDA graphs want them; the factor changes from step to step."""
    runs = []
    for is_capturable in (False, True):
        shared = [torch.nn.Parameter(p.detach().cuda()) for p in parameters((5, 3), (16, 16))]
        groups = [{"params": shared[:1]}, {"params": shared[1:], "orthogonal": True}]
        optimizer = AdamMuon([{**group, "initial_lr": 0.1} for group in groups], lr=0.1)
        if is_capturable:
            optimizer.make_capturable()
        for step in range(4):
            optimizer.set_rates(1 / (step + 1))
            for p in shared:
                p.grad = torch.sin(p.detach() + step)
            optimizer.step()
        assert {isinstance(group["lr"], torch.Tensor) for group in optimizer.param_groups} == {is_capturable}
        runs.append(shared)
    for a, b in zip(*runs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)  # steps of 0.1; their roots are taken in another order
