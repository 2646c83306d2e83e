"""Adam with orthogonalised momentum for matrices, and its rates: by declared groups, warmed up, held and falling."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from small_runs import small_renderer
from torch import Tensor, nn

from dnerf.training import AdamMuon, AdamSettings
from dnerf.training.optimizer import moments_of, orthogonalized


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("shape", [(2, 16, 16), (3, 64, 24), (1, 24, 128)])
def test_singular_values_become_nearly_one_and_nothing_is_turned(shape: tuple[int, ...]) -> None:
    matrices = normal(*shape, seed=1)
    found = orthogonalized(matrices)
    values = torch.linalg.svdvals(found)
    # Five rounds of the quintic; bfloat16 rounds each product by 2^-8.
    assert values.min() > 0.5
    assert values.max() < 1.3
    u, _, vh = torch.linalg.svd(matrices, full_matrices=False)  # its product with the polar factor is symmetric
    product = found @ (u @ vh).mT if shape[1] <= shape[2] else (u @ vh).mT @ found
    assert (product - product.mT).abs().max() < 0.06  # bfloat16
    assert product.diagonal(dim1=-2, dim2=-1).min() > 0.5


def test_size_and_sign_do_not_matter_and_zeros_stay() -> None:
    matrix = normal(1, 16, 20, seed=3)
    torch.testing.assert_close(orthogonalized(1024 * matrix), orthogonalized(matrix))
    torch.testing.assert_close(orthogonalized(-matrix), -orthogonalized(matrix))
    assert not orthogonalized(torch.zeros(1, 16, 20)).any()
    assert orthogonalized(matrix * 1e-30).isfinite().all()


def test_other_groups_take_the_very_steps_of_adam() -> None:
    plain, mixed = ([nn.Parameter(normal(*shape)) for shape in ((5, 3), (7,))] for _ in range(2))
    matrix = nn.Parameter(normal(16, 16))
    adam = torch.optim.Adam(plain, lr=0.1, betas=(0.8, 0.9))
    both = AdamMuon([{"params": mixed}, {"params": [matrix], "orthogonal": True}], lr=0.1, betas=(0.8, 0.9))
    for step in range(4):
        for p in (*plain, *mixed, matrix):
            p.grad = torch.full_like(p, step + 1.0)
        adam.step()
        both.step()
        assert matrix.grad is not None
    assert all(torch.equal(a, b) for a, b in zip(plain, mixed, strict=True))


def test_steps_have_the_size_of_adams() -> None:
    matrix = nn.Parameter(normal(48, 24))
    before = matrix.detach().clone()
    optimizer = AdamMuon([{"params": [matrix], "orthogonal": True}], lr=0.01)
    matrix.grad = normal(48, 24, seed=4)
    optimizer.step()
    root_mean_square = (matrix.detach() - before).square().mean().sqrt()
    assert 0.6 < root_mean_square / (0.01 * 0.2) < 1.3  # the range of the singular values


def test_it_solves_a_badly_scaled_problem_that_holds_adam_up() -> None:
    """Least squares of a matrix whose inputs differ in scale by 10^3: Adam's step per entry follows the rotation."""
    rotation = torch.linalg.qr(normal(32, 32, seed=5))[0]
    inputs = normal(512, 32, seed=6) * torch.logspace(0, -3, 32) @ rotation
    wanted = 0.1 * normal(32, 32, seed=7)
    errors = {}
    for orthogonal in (False, True):
        weight = nn.Parameter(torch.zeros(32, 32))
        optimizer = AdamMuon([{"params": [weight], "orthogonal": orthogonal}], lr=0.02)
        for step in range(200):
            optimizer.param_groups[0]["lr"] = 0.02 * (1 - step / 200)
            optimizer.zero_grad()
            (inputs @ (weight - wanted)).square().mean().backward()
            optimizer.step()
        errors[orthogonal] = float((weight.detach() - wanted).square().mean())
    assert errors[True] < 0.5 * errors[False]


def test_rates_are_those_of_declared_groups_and_declared_matrices_take_orthogonal_steps(caplog) -> None:
    renderer = small_renderer()
    rates = {"default": 1.0, "deformation": 2.0, "deformation_output": 3.0, "head": 4.0, "nobody": 5.0}
    optimizer = AdamSettings(rates, orthogonal=True).build(renderer)
    assert caplog.messages == ["learning_rates: no part of the model declares the group 'nobody'"]
    found = {id(p): (group["lr"], group["orthogonal"]) for group in optimizer.param_groups for p in group["params"]}
    beginnings = {
        "field.deformation.mlp.hidden": 2.0, "field.deformation.mlp.output": 3.0, "field.canonical.table": 1.0,
        "field.canonical.head": 4.0,
    }  # fmt: skip
    for name, parameter in renderer.named_parameters():
        (rate,) = [rate for beginning, rate in beginnings.items() if name.startswith(beginning)]
        assert found[id(parameter)] == (rate, "deformation.mlp.hidden" in name and parameter.ndim == 2)
    optimizer.set_rates(0.5)
    assert {group["lr"] for group in optimizer.param_groups} == {0.5, 1.0, 1.5, 2.0}
    plain = AdamSettings({"default": 1e-3, "head": 0.0}).build(renderer)
    assert {(group["lr"], group["orthogonal"]) for group in plain.param_groups} == {(1e-3, False), (0.0, False)}


def test_features_that_images_do_not_hold_are_forgotten_and_others_stay() -> None:
    renderer = small_renderer()
    table = renderer.field.canonical.table  # type: ignore[union-attr, operator]
    before, held = table.detach().clone(), torch.arange(len(table)) < 10
    optimizer = AdamSettings({"default": 1e-4}, weight_decays={"features": 1e-8}, epsilon=1e-15).build(renderer)
    for step in range(50):
        table.grad = torch.where(held[:, None], 1e-4 * (-1) ** step, 0.0).expand_as(table).clone()
        optimizer.step()
    torch.testing.assert_close(table[held].detach(), before[held], atol=2e-4, rtol=0)
    assert (table[~held].abs() < (before[~held].abs() - 3e-3).clamp(min=2e-3)).all()


def test_rates_rise_are_held_and_fall() -> None:
    settings = AdamSettings(final_rate=0.01, hold_until=0.5, warmup_steps=9)
    assert [settings.factor(step, 0.0) for step in (0, 4, 9, 20)] == pytest.approx([0.1, 0.5, 1.0, 1.0])
    assert [settings.factor(99, p) for p in (0.0, 0.5, 0.75, 1.0)] == pytest.approx([1.0, 1.0, 0.1, 0.01])
    assert settings.factor(4, 0.75) == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AdamSettings("fast"), "learning_rates must hold values by name, got 'fast'"),
        (lambda: AdamSettings({"default": "fast"}), "learning_rates.default must be a number, got 'fast'"),
        (lambda: AdamSettings({"default": -1e-3}), "learning_rates.default must be >= 0 and finite, got -0.001"),
        (lambda: AdamSettings({"head": 1e-3}), "learning_rates must have a rate for 'default', got"),
        (lambda: AdamSettings(weight_decays={"head": -1.0}), "weight_decays.head must be >= 0 and finite, got -1.0"),
        (lambda: AdamSettings(final_rate=0.0), "final_rate must be > 0"),
        (lambda: AdamSettings(hold_until=1.0), r"hold_until must be in \[0, 1\), got 1.0"),
        (lambda: AdamSettings(warmup_steps=1.5), "warmup_steps must be a whole number, got 1.5"),
        (lambda: AdamSettings(epsilon=-1), "epsilon must be >= 0 and finite, got -1"),
        (lambda: AdamSettings(betas=(0.9,)), r"betas must be two numbers in \[0, 1\), got \(0.9,\)"),
        (lambda: AdamSettings(betas=(0.9, 1.0)), r"betas must be two numbers in \[0, 1\), got \(0.9, 1.0\)"),
        (lambda: AdamMuon([{"params": [normal(3)], "orthogonal": True}]), r"matrices, got shape \(3,\)"),
        (lambda: moments_of(AdamMuon([{"params": [normal(3)]}]), nn.Parameter(normal(2))), "one of the optimiser's"),
    ],
)
def test_numbers_out_of_range_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.gpu
def test_rates_on_the_device_take_the_same_steps() -> None:
    """As CUDA graphs want them; the factor changes from step to step."""
    runs = []
    for is_capturable in (False, True):
        shared = [nn.Parameter(normal(*shape).cuda()) for shape in ((5, 3), (16, 16))]
        groups = [{"params": shared[:1]}, {"params": shared[1:], "orthogonal": True}]
        optimizer = AdamMuon([{**group, "initial_lr": 0.1} for group in groups], lr=0.1)
        if is_capturable:
            optimizer.make_capturable()
        for step in range(4):
            optimizer.set_rates(1 / (step + 1))
            for p in shared:
                p.grad = torch.sin(p.detach() + step)
            optimizer.step()
        assert {isinstance(group["lr"], Tensor) for group in optimizer.param_groups} == {is_capturable}
        runs.append(shared)
    for a, b in zip(*runs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)  # steps of 0.1; their roots are taken in another order
