import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.data import render_exact
from dnerf.evaluation import depth_consistency, flicker, sample_image, temporal_psnr, warping_error
from dnerf.scenes import exact_flow, make_scene


def brute_force_sample(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """Bilinear by tent weights of every pixel, edges repeated by clamping."""
    height, width = image.shape[:2]
    x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
    total = np.zeros(image.shape[2:])
    for i in range(height):
        for j in range(width):
            total = total + max(0, 1 - abs(x - j)) * max(0, 1 - abs(y - i)) * image[i, j]
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
    image = torch.rand(shape, dtype=torch.float64)
    pixels = 8 * torch.rand(40, 2, dtype=torch.float64) - 2
    pixels[:3] = torch.tensor([[0, 0], [shape[1] - 1, shape[0] - 1], [0.5, 0]])
    expected = np.stack([brute_force_sample(image.numpy(), x, y) for x, y in pixels.tolist()])
    np.testing.assert_allclose(sample_image(image, pixels), expected, atol=1e-12)


def test_warping_error_agrees_with_brute_force() -> None:
    first, second, flow, visible = random_pair()
    expected = brute_force_warping_error(first.numpy(), second.numpy(), flow.numpy(), visible.numpy())
    assert warping_error(first, second, flow, visible) == pytest.approx(expected, rel=1e-12)


def test_warping_error_of_an_image_shifted_by_its_flow_is_zero() -> None:
    image = torch.rand(8, 12, 3)
    flow = torch.zeros(8, 12, 2)
    flow[..., 0], flow[..., 1] = 2, -1
    shifted = image.roll((-1, 2), (0, 1))
    visible = torch.zeros(8, 12, dtype=torch.bool)
    visible[1:, :10] = True
    assert warping_error(image, shifted, flow, visible) == 0
    assert warping_error(image, shifted, -flow, visible) > 0.05
    assert math.isnan(warping_error(image, shifted, flow, torch.zeros_like(visible)))


def test_depth_consistency_is_the_relative_error() -> None:
    depth = 2 + torch.rand(6, 6, dtype=torch.float64)
    flow, visible = torch.zeros(6, 6, 2, dtype=torch.float64), torch.ones(6, 6, dtype=torch.bool)
    assert depth_consistency(depth, depth, flow, visible) == 0
    assert depth_consistency(depth, 1.1 * depth, flow, visible) == pytest.approx(0.1, rel=1e-9)
    visible[0] = False
    depth[0] = math.nan
    assert depth_consistency(depth, 0.9 * depth, flow, visible) == pytest.approx(0.1, rel=1e-9)


def test_depth_consistency_leaves_out_what_touches_background() -> None:
    depth, flow = torch.full((6, 6), 2.0, dtype=torch.float64), torch.zeros(6, 6, 2, dtype=torch.float64)
    visible, opaque = torch.ones(6, 6, dtype=torch.bool), torch.ones(6, 6, dtype=torch.bool)
    opaque[:, 3:] = False
    behind = torch.where(opaque, depth, 0.0)
    assert depth_consistency(depth, behind, flow, visible, second_opaque=opaque) == 0
    flow[..., 0] = 0.5  # column 2 is read halfway into the background
    assert depth_consistency(depth, behind, flow, visible) > 0.4
    assert depth_consistency(depth, behind, flow, visible, second_opaque=opaque) == 0
    assert math.isnan(depth_consistency(depth, behind, flow, visible, second_opaque=torch.zeros_like(opaque)))


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


def test_exact_vectors_explain_true_images_and_others_do_not() -> None:
    """On the true images the error is that of interpolation and edges; it falls with the resolution, as it must."""
    scene = make_scene("walker")
    errors, wrong, depths, wrong_depths = [], [], [], []
    for size in (40, 80):
        camera = Camera(Intrinsics.from_angle(size, size, 0.7), look_at((3.6, 0.4, 1.6)))
        images, depth = [], []
        for time in (0.2, 0.26):
            rgb, _, far = render_exact(scene, camera.rays(time), torch.ones(3))
            images.append(rgb.reshape(size, size, 3))
            depth.append(far.reshape(size, size))
        flow = exact_flow(scene, camera, 0.2, camera, 0.26)
        moving = flow.visible & (flow.vectors.norm(dim=-1) > 0.5)
        errors.append(warping_error(*images, flow.vectors, moving))
        wrong.append(warping_error(*images, -flow.vectors, moving))
        opaque = depth[1] > 0
        for sign, found in ((1, depths), (-1, wrong_depths)):
            vectors = sign * flow.vectors
            found.append(depth_consistency(flow.moved_depth, depth[1].double(), vectors, moving, second_opaque=opaque))
    assert errors[1] < errors[0]
    assert wrong[1] > 3 * errors[1]
    # Depth is 1 / 80 behind the surface, of a distance of 4: 0.003; where bodies hide each other it mixes both.
    assert depths[1] < depths[0]
    assert depths[1] < 0.02
    assert wrong_depths[1] > 1.2 * depths[1]


@pytest.mark.parametrize(("measure", "shapes", "message"), [
    (warping_error, [(7, 9, 3), (7, 9, 3), (3, 9, 2), (7, 9)], r"flow must have shape \(7, 9, 2\)"),
    (warping_error, [(7, 9, 3), (3, 9, 3), (7, 9, 2), (7, 9)], "visible must be bool, got torch.float32"),
    (depth_consistency, [(7, 9, 3), (7, 9), (7, 9, 2), (7, 9)], "first_depth must have shape"),
    (flicker, [(2, 4, 4, 3)], "frames must be at least 3, got 2"),
    (temporal_psnr, [(1, 4, 4, 3), (1, 4, 4, 3)], "frames must be at least 2, got 1"),
    (temporal_psnr, [(2, 4, 4, 3), (3, 4, 4, 3)], "truths must have shape"),
    (sample_image, [(7, 9, 3), (4, 3)], r"pixels must have shape \(..., 2\)"),
])  # fmt: skip
def test_what_does_not_fit_is_named(measure: Callable, shapes: list[tuple[int, ...]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        measure(*(torch.zeros(shape) for shape in shapes))


def test_second_images_of_another_shape_and_pixels_that_are_no_numbers_are_named() -> None:
    first, second, flow, visible = random_pair()
    for measure, name in ((warping_error, "second"), (depth_consistency, "second_depth")):
        images = (first, second[:3]) if name == "second" else (first[..., 0], second[:3, :, 0])
        with pytest.raises(ValueError, match=f"{name} must have shape"):
            measure(*images, flow, visible)
    with pytest.raises(ValueError, match="pixels must be numbers, got 1 that are not"):
        sample_image(first, torch.tensor([[0.0, 1.0], [math.nan, 1.0]]))
