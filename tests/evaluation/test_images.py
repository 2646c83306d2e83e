import math

import numpy as np
import pytest
import torch

from dnerf.evaluation import psnr, ssim


def brute_force_ssim(prediction: np.ndarray, target: np.ndarray) -> float:
    """Wang et al. 2004, equations 12-17, window by window, of images reflected at their edges."""
    reflection = ((5, 5), (5, 5), (0, 0))
    prediction, target = np.pad(prediction, reflection, "reflect"), np.pad(target, reflection, "reflect")
    offsets = np.arange(11) - 5
    one = np.exp(-0.5 * (offsets / 1.5) ** 2)
    window = np.outer(one, one) / np.outer(one, one).sum()
    c1, c2 = 0.01**2, 0.03**2
    values = []
    for y, x, c in np.ndindex(prediction.shape[0] - 10, prediction.shape[1] - 10, 3):
        a, b = prediction[y : y + 11, x : x + 11, c], target[y : y + 11, x : x + 11, c]
        mean_a, mean_b = (window * a).sum(), (window * b).sum()
        var_a, var_b = (window * (a - mean_a) ** 2).sum(), (window * (b - mean_b) ** 2).sum()
        cov = (window * (a - mean_a) * (b - mean_b)).sum()
        below = (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
        values.append((2 * mean_a * mean_b + c1) * (2 * cov + c2) / below)
    return float(np.mean(values))


@pytest.mark.parametrize("offset", [0.1, 0.01, 0.001])
def test_psnr_of_a_constant_error_is_its_logarithm(offset: float) -> None:
    target = torch.full((4, 5, 3), 0.5, dtype=torch.float64)
    assert psnr(target + offset, target) == pytest.approx(-20 * math.log10(offset), rel=1e-12)


def test_psnr_is_of_the_mean_over_all_pixels_and_channels_of_the_clamped_prediction() -> None:
    target = torch.zeros(2, 2, 3)
    prediction = target.clone()
    prediction[0, 1, 2] = 0.5
    assert psnr(prediction, target) == pytest.approx(10 * math.log10(12 / 0.25), rel=1e-6)
    image = torch.rand(3, 3, 3)
    assert psnr(image, image) == math.inf
    target = torch.tensor([0.0, 1.0])
    assert psnr(torch.tensor([-3.0, 2.0]), target) == math.inf
    assert psnr(torch.tensor([-3.0, 0.9]), target) == pytest.approx(10 * math.log10(2 / 0.01), rel=1e-5)


def test_nan_is_not_hidden() -> None:
    image = torch.rand(12, 12, 3)
    broken = image.clone()
    broken[6, 6, 0] = math.nan
    assert math.isnan(psnr(broken, image))
    assert math.isnan(ssim(broken, image))


def test_psnr_in_bfloat16_is_computed_in_float32() -> None:
    target = torch.rand(64, 64, 3)
    prediction = (target + 0.1 * torch.randn(64, 64, 3)).clamp(0, 1)
    exact = psnr(prediction.bfloat16().float(), target)
    assert psnr(prediction.bfloat16(), target) == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("size", [(17, 14), (11, 11)])
def test_ssim_agrees_with_brute_force(size: tuple[int, int]) -> None:
    target = torch.rand(*size, 3, dtype=torch.float64)
    prediction = (target + 0.2 * torch.randn_like(target)).clamp(0, 1)
    assert ssim(prediction, target) == pytest.approx(brute_force_ssim(prediction.numpy(), target.numpy()), abs=1e-10)


def test_ssim_of_structured_images_agrees_with_brute_force() -> None:
    y, x = torch.meshgrid(torch.linspace(0, 9, 16), torch.linspace(0, 7, 20), indexing="ij")
    target = (0.5 + 0.4 * torch.stack([x.sin(), y.cos(), (x + y).sin()], dim=-1)).double()
    prediction = 0.9 * target + 0.05
    expected = brute_force_ssim(prediction.numpy(), target.numpy())
    assert 0.5 < expected < 1
    assert ssim(prediction, target) == pytest.approx(expected, abs=1e-10)
    # float32 loses digits in E[x^2] - E[x]^2
    assert ssim(prediction.float(), target.float()) == pytest.approx(expected, abs=1e-4)


def test_ssim_of_identical_images_is_one_and_clamps() -> None:
    target = torch.zeros(17, 14, 3)
    target[8:] = 1
    assert ssim(target, target) == pytest.approx(1, abs=1e-12)
    assert ssim(3 * target - 1, target) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("shape", [(10, 20, 3), (20, 10, 3), (20, 20), (20, 20, 4), (1, 20, 20, 3), (3, 20, 20)])
def test_ssim_needs_an_image_of_at_least_the_window(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"prediction must have shape \(H, W, 3\) with H and W at least 11"):
        ssim(torch.zeros(shape), torch.zeros(shape))


@pytest.mark.parametrize("metric", [psnr, ssim])
@pytest.mark.parametrize("shapes", [((12, 12, 3), (12, 13, 3)), ((12, 12, 3), (3,)), ((0, 3), (0, 3))])
def test_different_or_empty_shapes_are_refused(metric: object, shapes: tuple) -> None:
    assert callable(metric)
    with pytest.raises(ValueError, match="prediction and target must have the same shape and not be empty"):
        metric(torch.zeros(shapes[0]), torch.zeros(shapes[1]))
