"""Points carried by nodes, against rigid motions and the definition."""

import pytest
import torch
from kernels.backends import under
from torch import Tensor

from dnerf.core.geometry import so3_exp
from dnerf.kernels import blend_rigid
from dnerf.kernels.blend_rigid import turned_back


def scene(num_points: int = 60, num_frames: int = 3, num_nodes: int = 9, seed: int = 0) -> tuple[Tensor, ...]:
    """Points, their frames, motions and nodes."""
    generator = torch.Generator().manual_seed(seed)
    points, nodes = (torch.rand(n, 3, generator=generator, dtype=torch.float64) for n in (num_points, num_nodes))
    frames = torch.randint(num_frames, (num_points,), generator=generator)
    motions = 0.3 * torch.randn(num_frames, num_nodes, 6, generator=generator, dtype=torch.float64)
    return points, frames, motions, nodes


def test_rodrigues_vectors_turn_as_rotation_matrices_do():
    turns, vectors = torch.randn(2, 20, 3, dtype=torch.float64)
    angles = turns.norm(dim=-1, keepdim=True)
    expected = (so3_exp(turns).mT @ vectors[..., None])[..., 0] - vectors
    torch.testing.assert_close(turned_back(turns / angles * torch.tan(angles / 2), vectors), expected)


def test_nodes_of_one_rigid_motion_carry_all_points_exactly_so(backend):
    points, frames, motions, nodes = scene()
    turns, travels = 0.5 * torch.randn(2, 3, 3, dtype=torch.float64)
    angles = turns.norm(dim=-1, keepdim=True)
    rotations = so3_exp(turns)
    motions[..., :3] = (turns / angles * torch.tan(angles / 2))[:, None]
    motions[..., 3:] = nodes @ rotations.mT + travels[:, None] - nodes
    canonical = points + blend_rigid(points, frames, motions, nodes, 0.2)
    back = (rotations[frames] @ canonical[..., None])[..., 0] + travels[frames]
    torch.testing.assert_close(back, points)


def test_nodes_at_rest_move_nothing(backend):
    points, frames, motions, nodes = scene()
    assert not bool(blend_rigid(points, frames, torch.zeros_like(motions), nodes, 0.2).any())


@pytest.mark.parametrize("num_points", [0, 1, 60])
@pytest.mark.parametrize("radius", [0.01, 0.2, 5.0])
def test_numba_equals_reference(num_points, radius):
    results = []
    for backend in ("numba", "reference"):
        points, frames, motions, nodes = scene(num_points)
        points, motions = points.requires_grad_(), motions.requires_grad_()
        moved = under(backend, blend_rigid, points, frames, motions, nodes, radius)
        (moved * torch.arange(3)).square().sum().backward()
        results.append((moved, points.grad, motions.grad))
    for numba, reference in zip(*results, strict=True):
        torch.testing.assert_close(numba, reference)


def test_points_in_a_row_find_their_own_nearest_nodes():
    """Each point's search begins with what was nearest to the last one of its frame."""
    points, frames, motions, nodes = scene(num_points=400, num_nodes=50)
    together = under("numba", blend_rigid, points, frames.sort().values, motions, nodes, 0.1)
    alone = [under("numba", blend_rigid, points[i : i + 1], frames.sort().values[i : i + 1], motions, nodes, 0.1)
             for i in range(400)]  # fmt: skip
    assert torch.equal(together, torch.cat(alone))


def test_displacements_do_not_jump_where_the_nearest_nodes_change(backend):
    _, _, motions, nodes = scene(num_nodes=30)
    line = torch.linspace(0, 1, 20_001, dtype=torch.float64)[:, None] * torch.ones(3, dtype=torch.float64)
    moved = blend_rigid(line, torch.zeros(len(line), dtype=torch.int64), motions, nodes, 0.2)
    # Steps of 1e-4 at slopes of some ten; a jump could be as large as what nodes differ by, some tenths.
    assert moved.diff(dim=0).norm(dim=-1).amax() < 3e-3


def test_gradients_are_those_of_finite_differences(backend):
    points, frames, motions, nodes = scene(12)
    arguments = points.requires_grad_(), motions.requires_grad_()
    assert torch.autograd.gradcheck(lambda x, m: blend_rigid(x, frames, m, nodes, 0.2), arguments)


def test_too_few_nodes_and_other_shapes_are_named():
    points, frames, motions, nodes = scene()
    with pytest.raises(ValueError, match="nodes must be at least 5, got 4"):
        blend_rigid(points, frames, motions[:, :4], nodes[:4], 0.2)
    with pytest.raises(ValueError, match="motions must have shape"):
        blend_rigid(points, frames, motions[..., :5], nodes, 0.2)
