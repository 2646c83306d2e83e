"""What cells cover on an image: both versions agree, and a pixel's depths bound those of every cell its ray meets."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.backends import under
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.geometry import ray_box
from dnerf.kernels import Footprints, footprints

AABB = torch.tensor([[-1.0, -0.5, -0.8], [0.6, 1.0, 0.7]])


def camera_at(eye: tuple[float, float, float], *, pixel_origin: str = "center", focal: float = 40.0) -> Camera:
    intrinsics = Intrinsics(31, 22, focal, 1.2 * focal, center_x=14.3, center_y=12.9, pixel_origin=pixel_origin)
    return Camera(intrinsics, look_at(eye), 0.5, 9.0)


def seen(occupancy: Tensor, camera: Camera, backend: str, dtype: torch.dtype = torch.float32) -> Footprints | None:
    view = camera.intrinsics
    size = view.height, view.width
    return under(backend, footprints, occupancy, AABB.to(dtype), camera.pose.to(dtype), view.pinhole, size)


def cells(share: float, seed: int, shape: tuple[int, ...] = (7, 5, 6)) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) < share


@settings(max_examples=40, deadline=None)
@given(
    share=st.sampled_from([0.0, 0.01, 0.2, 1.0]),
    seed=st.integers(0, 999),
    focal=st.sampled_from([12.0, 40.0, 400.0]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_both_versions_agree_to_the_bit(share: float, seed: int, focal: float, dtype: torch.dtype) -> None:
    eye = torch.randn(3, generator=torch.Generator().manual_seed(seed))
    camera = camera_at(tuple((3 * eye / eye.norm()).tolist()), focal=focal)
    expected, found = (seen(cells(share, seed), camera, backend, dtype) for backend in ("reference", "numba"))
    assert all(torch.equal(*pair) for pair in zip(found, expected))
    assert expected.depths.dtype == dtype


@pytest.mark.parametrize("pixel_origin", ["center", "corner"])
def test_depths_bound_what_rays_meet(backend: str, pixel_origin: str) -> None:
    """Against every ray and every cell, in double precision."""
    num_met = 0
    for seed in range(6):
        occupancy = cells(0.03, seed)
        eye = torch.randn(3, generator=torch.Generator().manual_seed(seed))
        camera = camera_at(tuple((2.5 * eye / eye.norm()).tolist()), pixel_origin=pixel_origin)
        covered = seen(occupancy, camera, backend)
        rays = camera.rays(0.0).to(torch.float64)
        slant = rays.far / camera.far
        size = (AABB[1] - AABB[0]).double() / torch.tensor(occupancy.shape)
        bounds = torch.full((2, len(rays)), torch.nan, dtype=torch.float64)
        bounds[:, covered.pixels] = covered.depths.double()
        for cell in occupancy.nonzero():
            low = AABB[0].double() + cell * size
            enter, leave = ray_box(rays.origins, rays.directions, torch.stack([low, low + size]))
            met = leave - enter > 1e-5
            num_met += int(met.sum())
            assert (bounds[0, met] <= (enter / slant)[met] + 1e-5).all()
            assert (bounds[1, met] >= (leave / slant)[met] - 1e-5).all()
    assert num_met > 500


def test_one_cell_covers_its_rectangle_at_its_own_depths(backend: str) -> None:
    occupancy = torch.zeros(7, 5, 6, dtype=torch.bool)
    occupancy[3, 2, 4] = True
    camera = camera_at((3.0, 0.4, 0.2))
    covered = seen(occupancy, camera, backend)
    size = (AABB[1] - AABB[0]) / torch.tensor(occupancy.shape)
    corners = AABB[0] + (torch.tensor([3, 2, 4]) + torch.cartesian_prod(*[torch.arange(2)] * 3)) * size
    places, depth = camera.project(corners)
    (left, top), (right, bottom) = places.amin(0).floor().tolist(), places.amax(0).ceil().tolist()
    rows, columns = torch.arange(top, bottom + 1), torch.arange(left, right + 1)
    assert torch.equal(covered.pixels, (rows[:, None] * 31 + columns).flatten().long())
    bounds = torch.stack([depth.amin(), depth.amax()])[:, None]
    torch.testing.assert_close(covered.depths, bounds.expand_as(covered.depths))


def test_cells_beside_and_behind(backend: str) -> None:
    """Beside the image nothing is covered; a cell that does not lie before the camera has no rectangle."""
    occupancy = torch.zeros(7, 5, 6, dtype=torch.bool)
    occupancy[0, 0, 0] = True
    beside = seen(occupancy, camera_at((3.0, 0.4, 0.2), focal=4000.0), backend)
    assert [x.shape for x in beside] == [(0,), (2, 0)]
    occupancy[:] = True
    assert seen(occupancy, camera_at((0.1, 0.2, 0.1)), backend) is None
    assert seen(occupancy, camera_at((0.6, 0.2, 0.1)), backend) is None  # in a face


@pytest.mark.parametrize(("change", "message"), [
    ({"occupancy": torch.ones(2, 2) > 0}, r"occupancy must be bool of shape \(Gx"),
    ({"occupancy": torch.ones(2, 2, 2)}, "occupancy must be bool"),
    ({"pose": torch.eye(4)[:3]}, "pose must have shape"),
    ({"lens": (1.0, 1.0)}, "lens must be four numbers"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(change: dict, message: str) -> None:
    arguments = {"occupancy": torch.ones(2, 2, 2) > 0, "pose": torch.eye(4), "lens": (1.0, 1.0, 0.0, 0.0)}
    with pytest.raises(ValueError, match=message):
        footprints(aabb=AABB, size=(4, 4), **arguments | change)
