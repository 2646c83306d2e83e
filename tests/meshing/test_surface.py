"""Surfaces of exact shapes: how far they are off, that they are closed, and what is refused."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from exact_shapes import BOX, CENTER, ExactSurface, Fog, ball, box, capsule, torus

from dnerf.deformations import IdentityDeformation
from dnerf.fields import DeformedField
from dnerf.meshing import Mesh, extract_surface, share_on_box, surface, vertex_normals

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("skimage")

extract = partial(extract_surface, time=0.0, box=BOX)
LENGTH = math.sqrt(0.3**2 + 0.2**2 + 0.4**2)  # of the capsule's segment
VOLUMES = {
    ball: 4 / 3 * math.pi * 0.5**3, box: 8 * 0.5 * 0.4 * 0.3,
    capsule: math.pi * 0.3**2 * (LENGTH + 4 / 3 * 0.3), torus: 2 * math.pi**2 * 0.5 * 0.2**2,
}  # fmt: skip
SHAPES = pytest.mark.parametrize("shape", VOLUMES, ids=lambda shape: shape.__name__)


def solid(mesh: Mesh) -> "trimesh.Trimesh":
    return trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)


def distances(shape, mesh: Mesh) -> torch.Tensor:
    """How far places spread over the triangles are from the exact surface."""
    places, _ = trimesh.sample.sample_surface(solid(mesh), 20000, seed=0)
    return shape(torch.from_numpy(np.asarray(places)).float()).abs()


@SHAPES
def test_surface_is_closed_has_the_right_genus_and_faces_outwards(shape):
    made = solid(extract(ExactSurface(shape), resolution=40))
    assert made.is_watertight
    assert made.is_winding_consistent
    assert made.body_count == 1
    assert made.euler_number == (0 if shape is torus else 2)
    assert made.volume > 0


@SHAPES
def test_errors_of_distance_and_volume_fall_with_the_square_of_the_spacing(shape):
    errors = []
    for resolution in (24, 48, 96):
        # Where lattice points lie beside an edge is chance: the mean over some lattices.
        boxes = [torch.tensor(BOX) + shift * torch.tensor([0.031, 0.017, -0.013]) for shift in range(4)]
        meshes = [extract(ExactSurface(shape), box=shifted, resolution=resolution) for shifted in boxes]
        volumes = [abs(solid(mesh).volume / VOLUMES[shape] - 1) for mesh in meshes]
        errors.append([np.mean(volumes), np.mean([distances(shape, mesh).mean() for mesh in meshes])])
    orders = np.log2(np.divide(errors[0], errors[2])) / 2
    assert (orders > 1.8).all(), orders
    assert errors[2][0] < 2e-3
    assert errors[2][1] < 3e-4  # of shapes one in size


@SHAPES
def test_vertices_lie_on_the_surface_and_reach_all_of_it(shape):
    from scipy.spatial import cKDTree

    mesh = extract(ExactSurface(shape), resolution=48)
    assert shape(mesh.vertices).abs().max() < 1e-5
    x = (torch.rand(40000, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * 2
    x = x[shape(x).abs() < 0.1].requires_grad_()
    (gradient,) = torch.autograd.grad(shape(x).sum(), x)
    exact = (x - shape(x)[:, None] * gradient).detach()
    exact = exact[shape(exact).abs() < 1e-5]  # others are nearest to an edge, inside
    places, _ = trimesh.sample.sample_surface(solid(mesh), 100000, seed=0)
    reached, _ = cKDTree(places).query(exact.numpy())
    assert len(exact) > 1000
    # Half a cell, where the places are 0.006 apart; the box's corners are cut off within theirs.
    assert reached.max() < (0.045 if shape is box else 0.02)


@pytest.mark.parametrize("shape", [ball, capsule, torus], ids=lambda shape: shape.__name__)
def test_normals_are_the_distances_gradients_and_those_of_triangles_close_to_them(shape):
    mesh = extract(ExactSurface(shape), resolution=64)
    x = mesh.vertices.clone().requires_grad_()
    (exact,) = torch.autograd.grad(shape(x).sum(), x)
    torch.testing.assert_close(mesh.normals, exact, atol=1e-5, rtol=0)
    cosines = (vertex_normals(mesh.vertices, mesh.faces) * exact).sum(-1).clamp(-1, 1)
    degrees = torch.rad2deg(torch.acos(cosines))
    assert degrees.median() < 0.3
    assert degrees.quantile(0.99) < 3


def test_colour_is_that_seen_from_outside():
    mesh = extract(ExactSurface(ball), resolution=32)
    torch.testing.assert_close(mesh.rgb, 0.5 + 0.5 * (mesh.vertices - CENTER) / 0.5, atol=1e-5, rtol=0)


def test_a_density_is_found_at_its_level_and_at_the_default_one_however_steeply_it_falls():
    mesh = extract(Fog(ball, level=30.0, steepness=60.0), level=30.0, resolution=24)  # by 150 from cell to cell
    assert ball(mesh.vertices).abs().max() < 1e-4
    for resolution in (24, 32):  # half the light within a hundredth of the box's side, whatever the lattice
        mesh = extract(Fog(ball, level=math.log(2) / (0.01 * 2.0)), resolution=resolution)
        assert ball(mesh.vertices).abs().max() < 1e-4


def test_a_body_that_leaves_the_box_is_closed_by_its_face():
    def half(x):
        return (x - torch.tensor([0.0, 0.9, 0.0])).norm(dim=-1) - 0.5

    made = solid(extract(ExactSurface(half), resolution=48))
    assert made.is_watertight
    assert made.volume == pytest.approx(0.5 * VOLUMES[ball], rel=0.01)
    assert made.bounds[1, 1] == pytest.approx(0.9, abs=1e-3)


def test_the_surface_is_that_of_its_time():
    field = DeformedField(IdentityDeformation(), ExactSurface(ball, growth=0.2))
    for time in (0.0, 1.0):
        mesh = extract_surface(field, time, box=BOX, resolution=24)
        radii = (mesh.vertices - CENTER).norm(dim=-1)
        torch.testing.assert_close(radii, torch.full_like(radii, 0.5 + 0.2 * time), atol=1e-4, rtol=0)


def hollow(x, hole=0.0):
    """A ball with a cavity, and a hole of that radius into it."""
    shell = torch.maximum(ball(x), 0.35 - (x - CENTER).norm(dim=-1))
    drill = torch.minimum(hole - (x - CENTER)[..., :2].norm(dim=-1), x[..., 2] - CENTER[2])
    return torch.maximum(shell, drill) if hole else shell


def test_cavities_are_filled_and_gaps_into_them_closed_if_asked():
    made = extract(ExactSurface(hollow), resolution=48)
    assert solid(made).volume == pytest.approx(VOLUMES[ball], rel=0.01)
    drilled = ExactSurface(partial(hollow, hole=0.06))
    is_open, is_closed = (solid(extract(drilled, resolution=48, close_gaps=share)) for share in (0.0, 0.1))
    assert is_open.volume < 0.7 * VOLUMES[ball]
    assert is_closed.volume == pytest.approx(VOLUMES[ball], rel=0.01)
    assert is_closed.is_watertight
    assert solid(extract(ExactSurface(torus), resolution=48, close_gaps=0.1)).euler_number == 0  # a wide hole stays


def test_small_parts_are_left_out():
    def two(x):
        return torch.minimum(ball(x), (x - 0.7).norm(dim=-1) - 0.08)

    counts = [solid(extract(ExactSurface(two), resolution=48, min_share=share)).body_count for share in (0.0, 0.1)]
    assert counts == [2, 1]


def test_what_the_box_cuts_is_measured():
    """A ball through one side: a disc of the box and a dome, both of known area."""
    whole = extract(ExactSurface(ball), resolution=48)
    assert share_on_box(whole, BOX) == 0
    low, high = torch.tensor(BOX)
    cut = torch.stack([low, high.index_fill(0, torch.tensor(0), float(CENTER[0]) + 0.3)])
    disc, dome = math.pi * (0.5**2 - 0.3**2), 2 * math.pi * 0.5 * 0.8
    share = share_on_box(extract(ExactSurface(ball), box=cut, resolution=96), cut)
    assert share == pytest.approx(disc / (disc + dome), rel=0.05)  # less a rim of a cell


REFUSED = [
    (ExactSurface(lambda x: 1 + ball(x)), {}, r"mesh is empty: no distance of 0 at time 0 .* nearest is 0\.5"),
    (Fog(ball, level=1e-3, steepness=0.0), {}, r"mesh is empty: no density of 34\.66 .* nearest is 0\.001"),
    (Fog(ball), {"level": 0.0}, "level must be > 0"),
    (ExactSurface(ball), {"resolution": 100_000}, "fits into memory: one of 100003 x 90003 x 8000[34] points"),
    (ExactSurface(ball), {"resolution": 0}, "resolution must be > 0"),
    (ExactSurface(ball), {"min_share": 2.0}, r"min_share must be in \[0, 1\], got 2.0"),
    (ExactSurface(ball), {"close_gaps": -1.0}, r"close_gaps must be in \[0, 1\], got -1.0"),
]


@pytest.mark.parametrize(("field", "settings", "said"), REFUSED)
def test_what_makes_no_mesh_is_said_in_one_line(field, settings, said):
    with pytest.raises(ValueError, match=said) as error:
        extract(field, **({"resolution": 16} | settings))
    assert "\n" not in str(error.value)


def test_the_missing_extra_is_named(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(surface, "import_module", missing)
    with pytest.raises(ValueError, match=r"pip install 'dnerf\[mesh\]'"):
        extract(ExactSurface(ball), resolution=16)
