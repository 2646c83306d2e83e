"""Cameras against D-NeRF's formula, projections, and closed paths."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, camera_rays, look_at
from dnerf.core.geometry import so3_exp


def dnerf_rays(height: int, width: int, focal: float, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`get_rays_np` of D-NeRF's run_dnerf_helpers.py, as it stands there."""
    i, j = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32), indexing="xy")
    dirs = np.stack([(i - width * 0.5) / focal, -(j - height * 0.5) / focal, -np.ones_like(i)], -1)
    rays_d = np.sum(dirs[..., np.newaxis, :] * pose[:3, :3], -1)
    rays_o = np.broadcast_to(pose[:3, -1], np.shape(rays_d))
    return rays_o, rays_d


def some_pose(seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = so3_exp(torch.randn(3, generator=generator, dtype=torch.float64))
    pose[:3, 3] = torch.randn(3, generator=generator, dtype=torch.float64)
    return pose


def project(intrinsics: Intrinsics, pose: Tensor, points: Tensor) -> Tensor:
    """Continuous pixel coordinates (..., 2) of world points, measured from the image's upper left corner."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    x = 0.5 * intrinsics.width if intrinsics.center_x is None else intrinsics.center_x
    y = 0.5 * intrinsics.height if intrinsics.center_y is None else intrinsics.center_y
    depth = -local[..., 2]
    return torch.stack(
        [x + intrinsics.focal_x * local[..., 0] / depth, y - intrinsics.focal_y * local[..., 1] / depth], -1
    )


def test_corner_rays_are_those_of_dnerf() -> None:
    intrinsics = Intrinsics.from_angle(8, 6, 0.69, pixel_origin="corner")
    pose = some_pose()
    rays = Camera(intrinsics, pose, 2.0, 6.0).rays(0.25)
    origins, directions = dnerf_rays(6, 8, 0.5 * 8 / np.tan(0.5 * 0.69), pose.numpy())
    lengths = np.linalg.norm(directions, axis=-1, keepdims=True)
    np.testing.assert_allclose(rays.origins.numpy(), origins.reshape(-1, 3), rtol=1e-14)
    np.testing.assert_allclose(rays.directions.numpy(), (directions / lengths).reshape(-1, 3), rtol=0, atol=1e-14)
    # D-NeRF walks t = 2..6 along unnormalised directions: the same points.
    first = origins + 2 * directions
    last = origins + 6 * directions
    ours = rays.origins + rays.near[:, None] * rays.directions, rays.origins + rays.far[:, None] * rays.directions
    np.testing.assert_allclose(ours[0].numpy(), first.reshape(-1, 3), rtol=0, atol=1e-13)
    np.testing.assert_allclose(ours[1].numpy(), last.reshape(-1, 3), rtol=0, atol=1e-13)
    assert (rays.times == 0.25).all()


@pytest.mark.parametrize(("pixel_origin", "offset"), [("center", 0.5), ("corner", 0.0)])
@pytest.mark.parametrize("center", [(None, None), (3.2, 1.7)])
def test_rays_pass_through_their_pixels(
    pixel_origin: str, offset: float, center: tuple[float | None, float | None]
) -> None:
    intrinsics = Intrinsics(7, 5, 9.0, 11.0, *center, pixel_origin=pixel_origin)
    pose = some_pose(1)
    rays = Camera(intrinsics, pose).rays(0.0)
    pixels = project(intrinsics, pose, rays.origins + 3 * rays.directions).reshape(5, 7, 2)
    for row in range(5):
        for column in range(7):
            expected = torch.tensor([column + offset, row + offset], dtype=torch.float64)
            torch.testing.assert_close(pixels[row, column], expected, rtol=0, atol=1e-12)


def test_directions_have_unit_length_and_planes_are_z_depths() -> None:
    pose = some_pose(2)
    rays = Camera(Intrinsics.from_angle(9, 7, 1.2), pose, 1.5, 4.0).rays(1.0)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(63, dtype=torch.float64), rtol=1e-14, atol=0)
    viewing = -pose[:3, 2]
    for distance, depth in ((rays.near, 1.5), (rays.far, 4.0)):
        points = rays.origins + distance[:, None] * rays.directions
        depths = (points - pose[:3, 3]) @ viewing
        torch.testing.assert_close(depths, torch.full_like(depths, depth), rtol=1e-13, atol=0)


def test_first_pixel_is_upper_left() -> None:
    rays = Camera(Intrinsics.from_angle(4, 4, 1.0), torch.eye(4)).rays(0.0)
    x, y, z = rays.directions[0].tolist()
    assert x < 0 < y
    assert z < 0
    x, y, _ = rays.directions[3].tolist()
    assert x > 0
    assert y > 0
    x, y, _ = rays.directions[12].tolist()
    assert x < 0
    assert y < 0


def test_horizontal_angle_is_the_field_of_view() -> None:
    intrinsics = Intrinsics.from_angle(100, 60, math.radians(80))
    edges = intrinsics.pixel_directions(torch.tensor([-0.5, 99.5]), torch.tensor([29.5, 29.5]))
    angle = torch.arccos(torch.nn.functional.cosine_similarity(edges[0], edges[1], dim=0)).item()
    assert angle == pytest.approx(math.radians(80), rel=1e-6)


def test_each_ray_may_have_its_own_camera_and_time() -> None:
    intrinsics = Intrinsics.from_angle(8, 8, 0.8)
    poses = torch.stack([some_pose(seed) for seed in range(5)])
    columns, rows, times = torch.arange(5), torch.arange(5).flip(0), torch.rand(5, dtype=torch.float64)
    together = camera_rays(intrinsics, poses, columns, rows, times=times, near=1, far=2)
    for r in range(5):
        alone = Camera(intrinsics, poses[r], 1, 2).rays(times[r].item())[
            columns[r] + 8 * rows[r] : columns[r] + 8 * rows[r] + 1
        ]
        for name in ("origins", "directions", "times", "near", "far"):
            torch.testing.assert_close(getattr(together, name)[r], getattr(alone, name)[0], rtol=1e-14, atol=1e-15)


def test_rays_have_the_dtype_of_the_pose() -> None:
    intrinsics = Intrinsics.from_angle(800, 800, 0.69)
    single, double = (Camera(intrinsics, some_pose().to(dtype)).rays(0.1) for dtype in (torch.float32, torch.float64))
    assert single.directions.dtype == single.near.dtype == single.times.dtype == torch.float32
    torch.testing.assert_close(single.directions.double(), double.directions, rtol=0, atol=3e-7)


@pytest.mark.parametrize("center", [(None, None), (9.5, 4.0)])
def test_resized_camera_keeps_the_view(center: tuple[float | None, float | None]) -> None:
    whole = Intrinsics(16, 12, 20.0, 22.0, *center)
    half = whole.resized(8, 4)
    columns, rows = torch.arange(16).repeat(12), torch.arange(12).repeat_interleave(16)
    fine = whole.pixel_directions(columns, rows, torch.float64).reshape(4, 3, 8, 2, 3)
    columns, rows = torch.arange(8).repeat(4), torch.arange(4).repeat_interleave(8)
    coarse = half.pixel_directions(columns, rows, torch.float64).reshape(4, 8, 3)
    # A coarse pixel looks where the fine pixels that it covers look on average.
    torch.testing.assert_close(coarse, fine.mean((1, 3)), rtol=0, atol=1e-14)
    assert (half.width, half.height) == (8, 4)


@pytest.mark.parametrize("eye", [(4, 0, 0), (1, -2, 3), (0.5, 0.5, -3)])
def test_camera_looks_at_its_target_and_stands_upright(eye: tuple[float, float, float]) -> None:
    target = (0.3, -0.2, 0.1)
    pose = look_at(eye, target)
    rotation = pose[:3, :3].double()
    torch.testing.assert_close(rotation.T @ rotation, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-6)
    assert torch.linalg.det(rotation).item() == pytest.approx(1, abs=1e-6)
    assert pose[:3, 3].tolist() == pytest.approx(eye)
    assert pose[3].tolist() == [0, 0, 0, 1]
    towards = torch.tensor(target) - torch.tensor(eye, dtype=torch.float32)
    torch.testing.assert_close(-pose[:3, 2], towards / towards.norm(), rtol=0, atol=1e-6)
    assert pose[2, 0].item() == pytest.approx(0, abs=1e-6)
    assert pose[2, 1].item() > 0


@pytest.mark.parametrize("eye", [(0.0, 0.0, 0.0), (0.0, 0.0, 5.0), (0.0, 0.0, -5.0), (math.nan, 0.0, 0.0)])
def test_views_without_a_horizon_are_refused(eye: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="eye must differ from target"):
        look_at(eye)


@pytest.mark.parametrize(("call", "message"), [
    (lambda: Intrinsics(0, 4, 1.0, 1.0), "width must be > 0"),
    (lambda: Intrinsics(4, 4, -1.0, 1.0), "focal_x must be > 0"),
    (lambda: Intrinsics(4, 4, 1.0, math.nan), "focal_y must be > 0"),
    (lambda: Intrinsics(4, 4, 1.0, 1.0, pixel_origin="middle"), "pixel_origin must be one of center, corner"),
    (lambda: Intrinsics.from_angle(4, 4, math.pi), r"angle_x must be in \(0, pi\)"),
    (lambda: Intrinsics.from_angle(4, 4, 0.0), r"angle_x must be in \(0, pi\)"),
    (lambda: Camera(Intrinsics(4, 4, 1.0, 1.0), torch.eye(3)), r"pose must have shape \(4, 4\), got \(3, 3\)"),
    (lambda: Camera(Intrinsics(4, 4, 1.0, 1.0), torch.eye(4), 6.0, 2.0), "0 <= near < far"),
    (lambda: Camera(Intrinsics(4, 4, 1.0, 1.0), torch.eye(4), 2.0, 2.0), "0 <= near < far"),
    (lambda: Camera(Intrinsics(4, 4, 1.0, 1.0), torch.eye(4), -1.0, 2.0), "0 <= near < far"),
    (lambda: Camera(Intrinsics(4, 4, 1.0, 1.0), torch.eye(4), 1.0, math.inf), "0 <= near < far"),
])  # fmt: skip
def test_bad_cameras_are_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("pixel_origin", ["center", "corner"])
@pytest.mark.parametrize("center", [(None, None), (7.0, 2.5)])
def test_projection_finds_the_pixel_that_a_ray_goes_through(
    pixel_origin: str, center: tuple[float | None, float | None]
) -> None:
    intrinsics = Intrinsics(12, 9, 14.0, 17.0, *center, pixel_origin=pixel_origin)
    camera = Camera(intrinsics, some_pose(), 1.0, 3.0)
    rays = camera.rays(0.0)
    distances = rays.near + torch.rand(len(rays), dtype=torch.float64) * (rays.far - rays.near)
    pixels, depth = camera.project(rays.origins + distances[:, None] * rays.directions)
    index = torch.arange(12 * 9)
    expected = torch.stack([index % 12, index // 12], dim=-1).double()
    torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-9)
    # Planes are z-depths: distance over near's distance is depth over near.
    torch.testing.assert_close(depth, distances / rays.near * camera.near)
    _, behind = camera.project(rays.origins - rays.directions)
    assert (behind < 0).all()
