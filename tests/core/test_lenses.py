"""Lens distortion against OpenCV's formulas written out, and its inverse against bisection."""

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, camera_rays, look_at
from dnerf.core.frame_intrinsics import FrameIntrinsics
from dnerf.core.lenses import Distortion

LENSES = {
    "barrel": Distortion("opencv", (-0.28, 0.07), (4e-4, -3e-4)),
    "pincushion": Distortion("opencv", (0.2, 0.05, 0.01)),
    "rational": Distortion("opencv", (0.513, -2.727, 1.575, 0.395, -2.551, 1.502), (-6e-4, 2e-4)),  # of a depth camera
    "tangential": Distortion("opencv", (), (0.01, -0.02)),
    "fisheye": Distortion("fisheye", (0.02, -0.01, 0.004, -0.001)),
    "ideal fisheye": Distortion("fisheye"),
    "none": Distortion("opencv"),
}


def camera_with(lens: Distortion | None, width: int = 64, height: int = 48, focal: float = 40.0) -> Intrinsics:
    return Intrinsics(width, height, focal, 1.1 * focal, 0.52 * width, 0.45 * height, distortion=lens)


def opencv_pixel(intrinsics: Intrinsics, x: float, y: float, z: float) -> tuple[float, float]:
    """OpenCV's documentation written out, for a point x to the right, y down and z before the camera."""
    lens = intrinsics.distortion
    assert lens is not None
    k = (*lens.radial, 0, 0, 0, 0, 0, 0)
    p1, p2 = lens.tangential
    a, b = x / z, y / z
    r = math.hypot(a, b)
    if lens.model == "fisheye":
        theta = math.atan2(math.hypot(x, y), z)
        bent = theta + k[0] * theta**3 + k[1] * theta**5 + k[2] * theta**7 + k[3] * theta**9
        u, v = (a * bent / r, b * bent / r) if r > 0 else (0.0, 0.0)
    else:
        s = (1 + k[0] * r**2 + k[1] * r**4 + k[2] * r**6) / (1 + k[3] * r**2 + k[4] * r**4 + k[5] * r**6)
        u = a * s + 2 * p1 * a * b + p2 * (r**2 + 2 * a**2)
        v = b * s + p1 * (r**2 + 2 * b**2) + 2 * p2 * a * b
    return intrinsics.focal_x * u + intrinsics.center[0], intrinsics.focal_y * v + intrinsics.center[1]


def all_pixels(intrinsics: Intrinsics) -> tuple[Tensor, Tensor]:
    index = torch.arange(intrinsics.width * intrinsics.height)
    return index % intrinsics.width, index // intrinsics.width


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize(("pixel_origin", "offset"), [("center", 0.5), ("corner", 0.0)])
def test_the_ray_of_a_pixel_is_seen_there_by_opencvs_formula_to_a_millionth_of_a_pixel(
    name: str, pixel_origin: str, offset: float
) -> None:
    intrinsics = replace(camera_with(LENSES[name]), pixel_origin=pixel_origin)
    columns, rows = all_pixels(intrinsics)
    directions = intrinsics.pixel_directions(columns, rows, torch.float64)
    assert directions.dtype == torch.float64
    for column, row, (x, y, z) in zip(columns.tolist(), rows.tolist(), directions.tolist()):
        assert z == -1
        seen = opencv_pixel(intrinsics, x, -y, -z)
        assert seen == pytest.approx((column + offset, row + offset), abs=1e-6)


@pytest.mark.parametrize("name", LENSES)
def test_projection_is_opencvs_and_the_inverse_of_rays(name: str) -> None:
    camera = Camera(camera_with(LENSES[name]), torch.eye(4, dtype=torch.float64), 1.0, 3.0)
    rays = camera.rays(0.0)
    pixels, depth = camera.project(rays.origins + 2.5 * rays.near[:, None] * rays.directions)
    expected = torch.stack(all_pixels(camera.intrinsics), dim=-1).double()
    torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(depth, torch.full_like(depth, 2.5))
    for position in [(0.3, -0.2, -1.5), (-0.4, 0.1, -2.0), (0.0, 0.0, -1.0)]:
        found, _ = camera.project(torch.tensor(position, dtype=torch.float64))
        x, y, z = position
        edges = opencv_pixel(camera.intrinsics, x, -y, -z)
        assert found.tolist() == pytest.approx([edges[0] - 0.5, edges[1] - 0.5], abs=1e-9)


def test_an_ideal_fisheye_lens_sees_angles_as_distances() -> None:
    intrinsics = Intrinsics(101, 101, 60.0, 60.0, distortion=Distortion("fisheye"))
    columns = torch.arange(101)
    directions = intrinsics.pixel_directions(columns, torch.full_like(columns, 50), torch.float64)
    angles = torch.atan2(directions[:, 0], -directions[:, 2])
    torch.testing.assert_close(angles, (columns - 50).double() / 60, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["barrel", "fisheye", "rational"])
def test_reduced_images_have_the_same_lens(name: str) -> None:
    whole = camera_with(LENSES[name])
    half = whole.resized(32, 24)
    assert half.distortion == whole.distortion
    # The middle of a coarse pixel is the corner of four fine ones.
    columns, rows = all_pixels(half)
    fine = whole.pixel_directions(2 * columns + 0.5, 2 * rows + 0.5, torch.float64)
    torch.testing.assert_close(half.pixel_directions(columns, rows, torch.float64), fine, rtol=0, atol=1e-12)


@given(
    model=st.sampled_from(["opencv", "fisheye"]),
    radial=st.lists(st.floats(-0.3, 0.3), max_size=4),
    half=st.floats(0.1, 1.2),
)
def test_a_radial_lens_is_refused_where_it_folds_and_else_undone(model: str, radial: list[float], half: float) -> None:
    """Bisection on the profile, which rises up to the corner or not."""
    lens = Distortion(model, tuple(radial))
    corner = half * math.sqrt(2)
    angles = np.linspace(0, math.radians(89), 20_001)
    radii = np.tan(angles)
    k = np.array((*radial, *(0.0,) * (6 - len(radial))))
    if model == "fisheye":
        profile = angles * (1 + sum(k[i] * angles ** (2 * i + 2) for i in range(4)))
    else:
        above = 1 + sum(k[i] * radii ** (2 * i + 2) for i in range(3))
        profile = radii * above / (1 + sum(k[3 + i] * radii ** (2 * i + 2) for i in range(3)))
    falls = np.flatnonzero(np.diff(profile) <= 0)
    highest = profile[falls[0]] if len(falls) else profile[-1]
    if highest < 1.1 * corner:
        # Where it folds just beyond the corner it may be refused or not.
        context = pytest.raises(ValueError, match="must not fold over") if highest < corner else suppress(ValueError)
        with context:
            Intrinsics(64, 64, 32 / half, 32 / half, distortion=lens)
        return
    intrinsics = Intrinsics(64, 64, 32 / half, 32 / half, distortion=lens)
    x, y, _ = intrinsics.pixel_directions(torch.tensor([63.5]), torch.tensor([63.5]), torch.float64)[0].tolist()
    low, high = 0, falls[0] if len(falls) else len(radii) - 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if profile[middle] <= corner else (low, middle)
    assert radii[low] - 1e-9 <= math.hypot(x, y) <= radii[high] + 1e-9


@pytest.mark.parametrize(("lens", "focal"), [
    (Distortion("opencv", (-0.5,)), 20.0),  # r - r^3 / 2 turns at r = 0.82
    (Distortion("opencv", (0.0, 0.0, 0.0, 0.0, 1.0)), 20.0),
    (Distortion("fisheye", (-0.5,)), 20.0),
    (Distortion("fisheye"), 20.0),  # 115 degrees in the corners
])  # fmt: skip
def test_lenses_that_fold_or_look_sideways_inside_the_image_are_refused(lens: Distortion, focal: float) -> None:
    with pytest.raises(ValueError, match=r"must not fold over .* undistort the images, or crop them"):
        Intrinsics(64, 48, focal, focal, distortion=lens)
    Intrinsics(64, 48, 20 * focal, 20 * focal, distortion=lens)


def test_what_a_lens_folds_back_into_the_image_is_seen_outside_it() -> None:
    """r - 0.28 r^3 turns at r = 1.09: a point at r = 1.7 would be seen at 0.32, in the image."""
    intrinsics = Intrinsics(64, 64, 80.0, 80.0, distortion=Distortion("opencv", (-0.28,)))
    camera = Camera(intrinsics, torch.eye(4, dtype=torch.float64))
    for radius in (1.2, 1.7, 1.9, 5.0, 100.0):
        pixels, _ = camera.project(torch.tensor([radius, 0.0, -1.0], dtype=torch.float64))
        assert pixels[0] > 64


@pytest.mark.parametrize(
    "mixed", [("barrel", "pincushion"), ("barrel", "fisheye", None), (None, "fisheye"), (None, "tangential")]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rays_of_many_lenses_are_those_of_each(mixed: tuple[str | None, ...], dtype: torch.dtype) -> None:
    each = [camera_with(LENSES[name] if name else None, 40 + i, 30, 35.0 + i) for i, name in enumerate(mixed)]
    lenses = FrameIntrinsics([*each, each[0]], torch.device("cpu"))
    assert lenses.shared is None
    assert lenses.each[-1] is lenses.each[0]
    frames = torch.randint(len(each) + 1, (200,), generator=torch.Generator().manual_seed(0))
    columns, rows = torch.arange(200) % 40, torch.arange(200) % 30
    chosen = lenses.of(frames)
    directions = chosen.pixel_directions(columns, rows, dtype)
    tolerance = 1e-12 if dtype == torch.float64 else 3e-7  # one unit in the last place
    places = torch.rand(200, 2, dtype=dtype, generator=torch.Generator().manual_seed(1)) - 0.5
    seen = torch.stack(chosen.seen_at(*places.unbind(-1)), -1)
    for r, frame in enumerate(frames.tolist()):
        alone = lenses.each[frame]
        expected = alone.pixel_directions(columns[r], rows[r], dtype)
        torch.testing.assert_close(directions[r], expected, rtol=0, atol=tolerance)
        expected = torch.stack(alone.seen_at(*places[r]))
        torch.testing.assert_close(seen[r], expected, rtol=0, atol=64 * tolerance)


def test_rays_of_many_pinholes_have_the_bits_of_each() -> None:
    each = [Intrinsics(40, 30, 31.7 + i, 33.3, 19.1, 14.7 - i) for i in range(3)]
    lenses, frames = FrameIntrinsics(each, torch.device("cpu")), torch.arange(300) % 3
    columns, rows, poses = torch.arange(300) % 40, torch.arange(300) % 30, look_at((1.0, 2.0, 3.0)).expand(300, 4, 4)
    together = camera_rays(lenses.of(frames), poses, columns, rows, times=torch.zeros(300), near=1.0, far=2.0)
    for i, alone in enumerate(each):
        own = camera_rays(
            alone, poses[i::3], columns[i::3], rows[i::3], times=torch.zeros(100), near=1.0, far=2.0
        )  # fmt: skip
        assert torch.equal(together.directions[i::3], own.directions)
        assert torch.equal(together.near[i::3], own.near)


@pytest.mark.parametrize(("arguments", "message"), [
    (("thin prism",), "model must be one of opencv, fisheye"),
    (("opencv", (0.0,) * 7), "at most six|at most 6"),
    (("fisheye", (0.0,) * 5), "at most 4"),
    (("opencv", (math.nan,)), "must be finite"),
    (("fisheye", (), (0.1, 0.0)), "tangential must be 0"),
])  # fmt: skip
def test_bad_coefficients_are_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Distortion(*arguments)
