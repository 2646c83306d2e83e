"""Canonical meshes moved by known motions."""

from functools import partial

import pytest
import torch
from exact_shapes import BOX, ExactSurface, InvertibleRigid, Rigid, ball, torus

from dnerf.deformations import CachedDeformation, Deformation, FlowDeformation, IdentityDeformation
from dnerf.deformations.velocities import Velocity
from dnerf.fields import DeformedField, GridField
from dnerf.meshing import animate, extract_surface, mesh_through_time, vertex_normals

pytest.importorskip("skimage")

extract = partial(extract_surface, box=BOX, resolution=20)
TIMES = torch.linspace(0, 1, 5)


@pytest.fixture(scope="module")
def mesh():
    return extract(ExactSurface(torus), 0.0)


class Spin(Velocity):
    """Turns about an axis and travels along it: its flow is a rigid motion."""

    def forward(self, positions, times):
        return torch.linalg.cross(torch.tensor([0.0, 0.0, 1.5]).expand_as(positions), positions) + torch.tensor(
            [0, 0, 0.4]
        )


class SpinExactly(Rigid):
    spin, velocity = torch.tensor([0.0, 0.0, 1.5]), torch.tensor([0.0, 0.0, 0.4])


@pytest.mark.parametrize(
    ("deformation", "truth", "tolerance"),
    [
        (InvertibleRigid(), Rigid(), 1e-5),
        (Rigid(), Rigid(), 2e-3),  # iterated until the image is within 1e-3 in canonical space
        (FlowDeformation(Spin()), SpinExactly(), 1e-4),
    ],
)
def test_vertices_move_as_the_body_does(mesh, deformation, truth, tolerance):
    with torch.no_grad():
        made = animate(mesh, deformation, TIMES)
    times = TIMES[:, None].expand(-1, len(mesh.vertices))
    exact = truth.world(mesh.vertices.expand(len(TIMES), -1, -1), times)
    assert (made.positions - exact).norm(dim=-1).max() < tolerance
    assert made.is_found.all()
    assert made.num_left_out == 0
    moved = made.frame(4)
    assert torch.equal(moved.faces, mesh.faces)
    assert torch.equal(moved.rgb, mesh.rgb)
    turned = truth.world(vertex_normals(mesh.vertices, mesh.faces), times[4]) - truth.world(torch.zeros(3), TIMES[4])
    assert ((moved.normals - turned).norm(dim=-1) < 0.02).float().mean() > 0.99


def test_a_frames_own_lattice_is_inverted():
    """Linear displacements are exact on a lattice, which knows no derivatives."""

    class Stretch(Deformation):
        def forward(self, positions, times):
            return positions * (1 + 0.3 * times[..., None])

    mesh = extract(ExactSurface(ball), 0.0)
    made = animate(mesh, CachedDeformation(Stretch(), BOX, 8), TIMES)
    torch.testing.assert_close(made.positions[4], mesh.vertices / 1.3, atol=1e-3, rtol=0)


class Wall(Deformation):
    """From time 0.6 on nothing in the world is carried beyond x = `limit`; beyond 0.4 that is always so."""

    def __init__(self, limit):
        super().__init__()
        self.limit = limit

    def forward(self, positions, times):
        limit = torch.where(times > 0.6, self.limit, 0.4)
        return torch.cat([torch.minimum(positions[..., :1], limit[..., None]), positions[..., 1:]], dim=-1)


def test_vertices_without_a_place_are_filled_in_left_out_and_counted():
    mesh = extract(ExactSurface(ball), 0.0)
    made = animate(mesh, Wall(0.2), TIMES)
    x = made.mesh.vertices[:, 0]
    beyond = int((mesh.vertices[:, 0] > 0.401).sum())
    assert made.num_left_out >= beyond > 20
    assert 0.3 < x.max() < 0.401
    torch.testing.assert_close(made.is_found, ~((x > 0.201) & (TIMES[:, None] > 0.6)))
    assert (made.positions[4] - made.mesh.vertices).norm(dim=-1).max() < 1e-2  # as their neighbours, which stand still
    assert f"{made.num_left_out} vertices left out" in made.summary()
    assert f"{1 - made.is_found.float().mean():.2%} are filled in" in made.summary()
    with pytest.raises(ValueError, match="mesh is empty: no canonical triangle has a place in half of the frames"):
        animate(mesh, Wall(-0.9), torch.tensor([0.8, 0.9]))
    with pytest.raises(ValueError, match="times must be one at least"):
        animate(mesh, Rigid(), torch.empty(0))


def test_a_deformation_moves_the_canonical_surface_of_the_stated_time():
    field = DeformedField(InvertibleRigid(), ExactSurface(ball, growth=0.2))
    made = mesh_through_time(field, TIMES, extract, start=0.5)
    torch.testing.assert_close(ball(made.mesh.vertices), torch.full((len(made.mesh.vertices),), 0.1), atol=1e-3, rtol=0)
    distances = field.distance(made.positions[2], torch.full(made.positions.shape[1:2], 0.5))
    assert distances.abs().max() < 1e-3


def test_the_motion_of_what_changes_without_a_deformation_is_unknown():
    field = DeformedField(IdentityDeformation(), ExactSurface(ball, growth=0.3))
    assert mesh_through_time(field, TIMES, extract, start=0.5) is None


def test_a_static_field_has_one_frame():
    torch.manual_seed(0)
    field = DeformedField(IdentityDeformation(), GridField(BOX, (4,), 2, hidden_features=8, density_shift=6.0))
    made = mesh_through_time(field, TIMES, extract, start=0.5)
    assert made.positions.shape == (1, len(made.mesh.vertices), 3)
    assert torch.equal(made.frame(0).normals, made.mesh.normals)
