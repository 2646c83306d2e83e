import math

import numpy as np
import pytest
import torch
from torch import Tensor

from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.data import render_exact
from dnerf.metrics import depth_consistency, flicker, sample_picture, temporal_psnr, warping_error
from dnerf.scenes import exact_flow, make_scene


def brute_force_sample(picture: np.ndarray, x: float, y: float) -> np.ndarray:
    """Bilinear by tent weights of every pixel, edges repeated by clamping."""
    height, width = picture.shape[:2]
    x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
    total = np.zeros(picture.shape[2:])
    for i in range(height):
        for j in range(width):
            total = total + max(0, 1 - abs(x - j)) * max(0, 1 - abs(y - i)) * picture[i, j]
    return total


def brute_force_warping_error(first: np.ndarray, second: np.ndarray, flow: np.ndarray, visible: np.ndarray) -> float:
    errors = [
        ((brute_force_sample(second, j + flow[i, j, 0], i + flow[i, j, 1]) - first[i, j]) ** 2).mean()
        for i in range(first.shape[0])
        for j in range(first.shape[1])
        if visible[i, j]
    ]
    return float(np.mean(errors))


def random_pair() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    first, second = torch.rand(2, 7, 9, 3, dtype=torch.float64)
    flow = 3 * torch.randn(7, 9, 2, dtype=torch.float64)
    visible = torch.rand(7, 9) > 0.4
    flow[~visible] = math.nan
    return first, second, flow, visible


@pytest.mark.parametrize("shape", [(5, 6, 3), (5, 6), (1, 4, 2), (3, 1, 1), (1, 1, 3)])
def test_sampling_agrees_with_brute_force(shape: tuple[int, ...]) -> None:
    picture = torch.rand(shape, dtype=torch.float64)
    pixels = 8 * torch.rand(40, 2, dtype=torch.float64) - 2
    pixels[:3] = torch.tensor([[0, 0], [shape[1] - 1, shape[0] - 1], [0.5, 0]])
    expected = np.stack([brute_force_sample(picture.numpy(), x, y) for x, y in pixels.tolist()])
    np.testing.assert_allclose(sample_picture(picture, pixels), expected, atol=1e-12)


def test_warping_error_agrees_with_brute_force() -> None:
    first, second, flow, visible = random_pair()
    expected = brute_force_warping_error(first.numpy(), second.numpy(), flow.numpy(), visible.numpy())
    assert warping_error(first, second, flow, visible) == pytest.approx(expected, rel=1e-12)


def test_warping_error_of_a_picture_shifted_by_its_flow_is_zero() -> None:
    picture = torch.rand(8, 12, 3)
    flow = torch.zeros(8, 12, 2)
    flow[..., 0], flow[..., 1] = 2, -1
    shifted = picture.roll((-1, 2), (0, 1))
    visible = torch.zeros(8, 12, dtype=torch.bool)
    visible[1:, :10] = True
    assert warping_error(picture, shifted, flow, visible) == 0
    assert warping_error(picture, shifted, -flow, visible) > 0.05
    assert math.isnan(warping_error(picture, shifted, flow, torch.zeros_like(visible)))


def test_depth_consistency_is_the_relative_error() -> None:
    depth = 2 + torch.rand(6, 6, dtype=torch.float64)
    flow, visible = torch.zeros(6, 6, 2, dtype=torch.float64), torch.ones(6, 6, dtype=torch.bool)
    assert depth_consistency(depth, depth, flow, visible) == 0
    assert depth_consistency(depth, 1.1 * depth, flow, visible) == pytest.approx(0.1, rel=1e-9)
    visible[0] = False
    depth[0] = math.nan
    assert depth_consistency(depth, 0.9 * depth, flow, visible) == pytest.approx(0.1, rel=1e-9)


def test_temporal_psnr_is_blind_to_constant_errors_and_sees_noise() -> None:
    truths = torch.rand(6, 5, 4, 3)
    assert temporal_psnr(0.5 * truths + 0.25, 0.5 * truths) > 120
    pattern = torch.zeros(6, 1, 1, 1)
    pattern[::2] = 0.1  # every difference is off by 0.1
    assert temporal_psnr(0.5 * truths + pattern, 0.5 * truths) == pytest.approx(20, abs=1e-4)
    assert temporal_psnr(truths, truths) == math.inf
    assert temporal_psnr(2 * truths.round() - 0.5, truths.round()) == math.inf  # clamped


def test_flicker_of_fades_noise_and_sines() -> None:
    steps = torch.arange(400, dtype=torch.float64)[:, None, None, None]
    assert flicker(0.1 + 0.002 * steps.expand(-1, 3, 3, 3)) < 1e-6
    noise = 0.05 * torch.randn(400, 8, 8, 3)
    # 77 000 values: the estimate of the deviation is good to 0.5 % or so
    assert flicker(noise) == pytest.approx(math.sqrt(6) * 0.05, rel=0.02)
    omega = 2 * math.pi / 40
    wave = torch.sin(omega * steps).expand(-1, 2, 2, 1)
    assert flicker(wave) == pytest.approx(4 * math.sin(omega / 2) ** 2 / math.sqrt(2), rel=0.02)


def test_exact_vectors_explain_true_pictures_and_others_do_not() -> None:
    """On the true pictures the error is that of interpolation and edges; it falls with the resolution, as it must."""
    scene = make_scene("walker")
    errors, wrong, depths, wrong_depths = [], [], [], []
    for size in (40, 80):
        camera = Camera(Intrinsics.from_angle(size, size, 0.7), look_at((3.6, 0.4, 1.6)))
        pictures, depth = [], []
        for time in (0.2, 0.26):
            rgb, _, seen = render_exact(scene, camera.rays(time), torch.ones(3))
            pictures.append(rgb.reshape(size, size, 3))
            depth.append(seen.reshape(size, size))
        flow = exact_flow(scene, camera, 0.2, camera, 0.26)
        moving = flow.visible & (flow.vectors.norm(dim=-1) > 0.5)
        errors.append(warping_error(*pictures, flow.vectors, moving))
        wrong.append(warping_error(*pictures, -flow.vectors, moving))
        depths.append(depth_consistency(flow.moved_depth, depth[1].double(), flow.vectors, moving))
        wrong_depths.append(depth_consistency(flow.moved_depth, depth[1].double(), -flow.vectors, moving))
    assert errors[1] < errors[0]
    assert wrong[1] > 3 * errors[1]
    # Seen 1 / 80 behind the surface, of a distance of 4: 0.003; at silhouettes bilinear depth mixes near and empty (0).
    assert depths[1] < depths[0]
    assert depths[1] < 0.05
    assert wrong_depths[1] > 3 * depths[1]


def test_what_does_not_fit_is_named() -> None:
    first, second, flow, visible = random_pair()
    with pytest.raises(ValueError, match=r"flow must have shape \(7, 9, 2\)"):
        warping_error(first, second, flow[:3], visible)
    with pytest.raises(ValueError, match=r"second must have shape"):
        warping_error(first, second[:3], flow, visible)
    with pytest.raises(ValueError, match=r"visible must be bool, got torch.float32"):
        warping_error(first, second, flow, visible.float())
    with pytest.raises(ValueError, match=r"second_depth must have shape"):
        depth_consistency(first[..., 0], second[:3, :, 0], flow, visible)
    with pytest.raises(ValueError, match="frames must be at least 3, got 2"):
        flicker(torch.zeros(2, 4, 4, 3))
    with pytest.raises(ValueError, match="frames must be at least 2, got 1"):
        temporal_psnr(torch.zeros(1, 4, 4, 3), torch.zeros(1, 4, 4, 3))
    with pytest.raises(ValueError, match="truths must have shape"):
        temporal_psnr(torch.zeros(2, 4, 4, 3), torch.zeros(3, 4, 4, 3))
    with pytest.raises(ValueError, match=r"pixels must have shape \(..., 2\)"):
        sample_picture(first, torch.zeros(4, 3))
    with pytest.raises(ValueError, match="pixels must be numbers, got 1 that are not"):
        sample_picture(first, torch.tensor([[0.0, 1.0], [math.nan, 1.0]]))
