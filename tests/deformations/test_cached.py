"""The lattice that stands in for a deformation while one frame is rendered."""

import pytest
import torch
from reference import occupancy_sampler
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.deformations import CachedDeformation, Deformation, DisplacementDeformation, IdentityDeformation
from dnerf.deformations.cached import VERTICES_PER_RAY
from dnerf.fields import DeformedField, GridField
from dnerf.kernels import MarchGrid, skip_distances
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler

BOX = [[-1.0, -1.0, -1.0], [1.0, 1.0, 0.5]]


class Bend(Deformation):
    """A smooth map whose second derivatives are at most 0.5, and which counts where it is evaluated."""

    num_points = 0

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        self.num_points += len(positions)
        return positions + times[..., None] * torch.sin(positions.roll(1, -1)) * 0.5


def points(count: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype)
    low, high = torch.tensor(BOX, dtype=dtype)
    return torch.lerp(low, high, unit)


def error(resolution: int) -> float:
    bend, x = Bend(), points(4000)
    times = x.new_full((len(x),), 0.7)
    return float((CachedDeformation(bend, BOX, resolution).at_time(0.7)(x, times) - bend(x, times)).abs().max())


def test_error_falls_with_the_square_of_the_cells_and_stays_below_its_bound() -> None:
    errors = [error(r) for r in (4, 8, 16)]
    for resolution, value in zip((4, 8, 16), errors, strict=True):
        # Linear interpolation along one axis of f with |f''| <= 0.35 (each component bends along one axis).
        assert value <= 0.35 * (2 / resolution) ** 2 / 8 * 1.001 + 1e-7  # the lattice holds float32
    assert errors[0] / errors[1] > 3.5
    assert errors[1] / errors[2] > 3.5


def test_vertices_are_exact_and_evaluated_once() -> None:
    bend = Bend()
    frozen = CachedDeformation(bend, [[-1.0] * 3, [1.0] * 3], 8).at_time(0.5)
    frozen.pad_to = 1
    axis = torch.linspace(-1, 1, 9)
    vertices = torch.cartesian_prod(axis, axis, axis)
    times = vertices.new_full((len(vertices),), 0.5)
    torch.testing.assert_close(frozen(vertices, times), Bend()(vertices, times), rtol=0, atol=2e-7)
    assert bend.num_points == 9**3
    frozen(vertices * 0.9, times)
    assert bend.num_points == 9**3


def test_only_cells_with_points_are_evaluated() -> None:
    bend = Bend()
    frozen = CachedDeformation(bend, BOX, 64).at_time(0.5)
    frozen.pad_to = 1
    frozen(torch.tensor([[0.01, 0.01, 0.01]]), torch.tensor([0.5]))
    assert bend.num_points == 8
    frozen(torch.tensor([[0.04, 0.01, 0.01]]), torch.tensor([0.5]))  # the next cell shares a face
    assert bend.num_points == 12


def test_vertices_around_cells_are_those_that_points_in_them_need() -> None:
    size, aabb = (7, 5, 6), torch.tensor([[-0.93, -1.21, -0.64], [1.17, 0.88, 0.41]])  # partly outside
    occupied = torch.rand(size, generator=torch.Generator().manual_seed(3)) < 0.05
    cells = occupied.nonzero()
    assert len(cells)
    lattice = CachedDeformation(Bend(), BOX, 12)
    inside = torch.linspace(1e-4, 1 - 1e-4, 30)
    offsets = torch.cartesian_prod(inside, inside, inside)
    points = torch.lerp(*aabb, ((cells[:, None] + offsets) / torch.tensor(size)).reshape(-1, 3))
    low, high = torch.tensor(BOX)
    points = points[((points > low) & (points < high)).all(-1)]
    evaluated = lattice.at_time(0.5)
    evaluated(points, points.new_full((len(points),), 0.5))
    found = lattice.at_time(0.5).vertices_around(occupied, aabb)
    assert torch.equal(found, evaluated.is_known.view(-1).nonzero()[:, 0])
    assert not len(evaluated.vertices_around(occupied, aabb))  # they are known
    assert not len(lattice.at_time(0.5).vertices_around(occupied & False, aabb))


def test_parts_of_intervals_beside_cells_find_their_vertices_filled() -> None:
    """Of an interval whose middle is in a cell, cut into three, two parts' middles may lie beside it."""
    occupied = torch.rand(7, 5, 6, generator=torch.Generator().manual_seed(3)) < 0.1
    grid = MarchGrid(occupied, skip_distances(occupied[None])[0], torch.tensor(BOX), 0.09, 3, 0.0)
    frozen = CachedDeformation(Bend(), BOX, 40).at_time(0.5)
    assert frozen.fill_around(grid, 10**6)
    known = frozen.is_known.clone()
    g = torch.Generator().manual_seed(4)
    shares = (occupied.nonzero()[:, None] + torch.rand(200, 3, generator=g)) / torch.tensor(occupied.shape)
    middles = torch.lerp(*grid.aabb, shares.reshape(-1, 3))
    directions = torch.nn.functional.normalize(torch.randn(middles.shape, generator=g), dim=-1)
    points = torch.cat([middles, middles - 0.03 * directions, middles + 0.03 * directions])
    points = torch.maximum(torch.minimum(points, grid.aabb[1]), grid.aabb[0])
    frozen(points, points.new_full((len(points),), 0.5))
    assert torch.equal(frozen.is_known, known)
    assert not known.all()


def test_what_rays_will_want_is_filled_at_once_unless_it_is_too_much() -> None:
    occupied = torch.zeros(7, 5, 6, dtype=torch.bool)
    occupied[2:4, 1, 3:5] = True
    grid = MarchGrid(occupied, skip_distances(occupied[None])[0], torch.tensor(BOX), 0.02, 1, 0.0)
    bend = Bend()
    frozen = CachedDeformation(bend, BOX, 12).at_time(0.5)
    wanted = len(frozen.vertices_around(occupied, grid.aabb))
    assert not frozen.fill_around(grid, (wanted - 1) // VERTICES_PER_RAY)
    assert not bend.num_points
    assert frozen.fill_around(grid, -(-wanted // VERTICES_PER_RAY))
    evaluated = bend.num_points
    low, high = torch.lerp(*torch.tensor(BOX), torch.tensor([[2, 1, 3], [4, 2, 5]]) / torch.tensor([7, 5, 6]))
    x = torch.lerp(low + 1e-4, high - 1e-4, torch.rand(200, 3))
    torch.testing.assert_close(
        frozen(x, torch.full((200,), 0.5)), Bend()(x, torch.full((200,), 0.5)), atol=0.01, rtol=0
    )
    assert bend.num_points == evaluated


def test_vertices_are_evaluated_in_parts_where_there_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    class Most(Bend):
        most = 0

        def forward(self, positions: Tensor, times: Tensor) -> Tensor:
            self.most = max(self.most, len(positions))
            return super().forward(positions, times)

    x, times, bend = points(2000, 5, torch.float32), torch.full((2000,), 0.4), Most()
    whole = CachedDeformation(Bend(), BOX, 16).at_time(0.4)(x, times)
    monkeypatch.setattr("dnerf.deformations.cached.MOST_AT_ONCE", 300)
    frozen = CachedDeformation(bend, BOX, 16).at_time(0.4)
    frozen.pad_to = 100
    assert torch.equal(frozen(x, times), whole)
    assert 0 < bend.most <= 300
    assert bend.num_points > 2000


def test_outside_its_box_the_deformation_itself_is_evaluated() -> None:
    x = points(50, 3, torch.float32) * 3
    times = torch.full((50,), 0.3)
    outside = (x < torch.tensor(BOX[0])).any(-1) | (x > torch.tensor(BOX[1])).any(-1)
    frozen = CachedDeformation(Bend(), BOX, 4).at_time(0.3)(x, times)
    assert outside.any()
    assert torch.equal(frozen[outside], Bend()(x, times)[outside])


def test_part_of_a_lattice_holds_what_the_whole_one_does() -> None:
    x = points(3000, 1, torch.float32)
    times = torch.full((3000,), 0.7)
    lattice, extent = CachedDeformation(Bend(), BOX, 24), torch.tensor([[-0.31, -2.0, 0.1], [0.42, 0.55, 0.2]])
    whole, part = lattice.at_time(0.7), lattice.at_time(0.7, extent)
    assert part.is_known.numel() < 0.2 * whole.is_known.numel()
    inside = ((x >= extent[0]) & (x <= extent[1])).all(-1)
    expected, found = whole(x, times), part(x, times)
    torch.testing.assert_close(found[inside], expected[inside], rtol=0, atol=1e-6)  # fractions round otherwise
    assert inside.sum() > 50
    beyond = ((x < part.low) | (x > part.low + part.sides)).any(-1)
    assert torch.equal(found[beyond], Bend()(x, times)[beyond])
    assert (beyond & ~inside).sum() > 1000
    assert not (beyond & inside).any()


@pytest.mark.parametrize("corners", [(2.0, 3.0), (-3.0, -2.0), (0.1, 0.1), (0.3, 0.2)])
def test_part_of_a_lattice_where_there_is_none_is_still_one(corners: tuple[float, float]) -> None:
    extent = torch.tensor(corners)[:, None].expand(2, 3)
    part = CachedDeformation(Bend(), BOX, 24).at_time(0.7, extent)
    assert 8 <= part.is_known.numel() <= 27
    x = points(40, 2, torch.float32)
    times = torch.full((40,), 0.7)
    torch.testing.assert_close(part(x, times), Bend()(x, times), rtol=0, atol=1e-3)


def test_shapes_emptiness_and_other_times() -> None:
    frozen = CachedDeformation(Bend(), BOX, 4).at_time(0.25)
    assert frozen(torch.zeros(2, 3, 3), torch.full((2, 3), 0.25)).shape == (2, 3, 3)
    assert frozen(torch.zeros(0, 3), torch.zeros(0)).shape == (0, 3)
    with pytest.raises(ValueError, match=r"times must all be 0.25"):
        frozen(torch.zeros(2, 3), torch.tensor([0.25, 0.3]))
    with pytest.raises(ValueError, match="resolution"):
        CachedDeformation(Bend(), BOX, 0)


@pytest.mark.parametrize("packed", [True, False])
def test_images_hardly_change_and_training_does_not_see_it(packed: bool) -> None:
    torch.manual_seed(0)
    deformation = DisplacementDeformation(2, 16, (), position_frequencies=2, time_frequencies=2)
    torch.nn.init.normal_(deformation.mlp.output.weight, std=0.05)
    canonical = GridField(BOX, (4, 8), 4, hidden_features=8, density_shift=1.0)
    exact, cached = (DeformedField(x, canonical) for x in (deformation, CachedDeformation(deformation, BOX, 32)))
    sampler = occupancy_sampler(BOX, 0.05, 8) if packed else StratifiedSampler(32, box=BOX)
    camera = Camera(Intrinsics(24, 24, 30.0, 30.0), look_at((0.0, -3.0, 0.5), (0.0, 0.0, 0.0)))
    images = [Renderer(field, sampler).render_image(camera, 0.6).rgb for field in (exact, cached)]
    assert images[0].std() > 0.01
    torch.testing.assert_close(images[0], images[1], rtol=0, atol=2e-3)
    assert not torch.equal(*images)  # the lattice was evaluated
    rays = camera.rays(0.6)[:50]
    seen = [Renderer(field, sampler).eval()(rays).rgb for field in (exact, cached)]
    assert torch.equal(*seen)


def test_what_does_not_move_is_not_cached() -> None:
    still = IdentityDeformation()
    assert CachedDeformation(still, BOX).at_time(0.5) is still


def test_a_deformation_that_fails_once_is_evaluated_again() -> None:
    class Failing(Bend):
        fails = True

        def forward(self, positions: Tensor, times: Tensor) -> Tensor:
            if self.fails:
                self.fails = False
                raise torch.OutOfMemoryError
            return super().forward(positions, times)

    x = points(50)
    times = x.new_full((50,), 0.7)
    frozen = CachedDeformation(Failing(), BOX, 16).at_time(0.7)
    with pytest.raises(torch.OutOfMemoryError):
        frozen(x, times)
    assert torch.equal(frozen(x, times), CachedDeformation(Bend(), BOX, 16).at_time(0.7)(x, times))


@pytest.mark.parametrize("strange", [float("inf"), -float("inf"), 1e30])
def test_points_far_away_are_evaluated_of_the_deformation(strange: float) -> None:
    x = torch.tensor([[0.1, 0.2, 0.3], [strange, 0.0, 0.0]], dtype=torch.float64)
    moved = CachedDeformation(Bend(), BOX, 16).at_time(0.7)(x, x.new_full((2,), 0.7))
    assert torch.equal(moved[1].nan_to_num(), Bend()(x, x.new_full((2,), 0.7))[1].nan_to_num())


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_positions_in_half_precision_find_their_cells(dtype: torch.dtype) -> None:
    bend = Bend()
    axis = torch.linspace(-1, 1, 41)
    positions = torch.cartesian_prod(axis, axis, axis)[::7].to(dtype)
    frozen = CachedDeformation(bend, [[-1.0] * 3, [1.0] * 3], 20).at_time(0.5)
    moved = frozen(positions, positions.new_full((len(positions),), 0.5))
    exact = bend(positions.float(), torch.full((len(positions),), 0.5))
    # The lattice's own error, see above, and the rounding of the sum.
    torch.testing.assert_close(moved.float(), exact, rtol=0, atol=0.18 * 0.1**2 / 8 * 3 + 2**-7)
