"""Voxels: sums of interpolated tables, exact integrals along rays, harmonics of the direction, levels that open."""

import itertools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.polynomial import Polynomial
from small_runs import Watch, small_frames, small_trainer, weights
from torch import Tensor

from dnerf.core.backgrounds import RandomBackground
from dnerf.deformations import IdentityDeformation
from dnerf.fields import DeformedField, VoxelField
from dnerf.rendering import Renderer
from dnerf.samplers import OccupancyGrid, OccupancySampler
from dnerf.training import Checkpoints, Run, Trainer, WeightAverage

BOX = [[-1.0, 0.0, 2.0], [1.0, 1.0, 6.0]]
CELLS = [(2, 1, 4), (3, 2, 6), (6, 3, 12)]  # of levels of 4, 6 and 12 cells along the longest of sides 2, 1, 4


def filled(std: float = 0.5, **settings: object) -> VoxelField:
    """Random voxels of three levels, of which the first two have harmonics, in float64."""
    field = VoxelField(BOX, (4, 6, 12), **{"view_resolution": 6, "density_activation": "softplus", **settings}).double()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for table in field.parameters():
            table.copy_(std * torch.randn(table.shape, generator=generator, dtype=torch.float64))
    return field


def some_points(count: int = 20) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    low, high = torch.tensor(BOX, dtype=torch.float64)
    unit, directions = torch.rand((2, count, 3), generator=generator, dtype=torch.float64)
    return torch.lerp(low, high, unit), torch.nn.functional.normalize(directions - 0.5, dim=-1), unit[:, 0]


def rows_of(cells: tuple[int, int, int]) -> list[tuple[int, ...]]:
    """Vertices (x, y, z) in the order of a table's rows."""
    return [v[::-1] for v in itertools.product(*(range(n + 1) for n in reversed(cells)))]


def looked_up(tables: list[Tensor], place: list[float]) -> Tensor:
    """One place's values: of all levels, vertex by vertex."""
    total = torch.zeros(tables[0].shape[1], dtype=torch.float64)
    for table, cells in zip(tables, CELLS):
        scaled = [(p - a) / (b - a) * n for p, a, b, n in zip(place, *BOX, cells, strict=True)]
        for row, vertex in enumerate(rows_of(cells)):
            total += math.prod(max(0.0, 1 - abs(s - v)) for s, v in zip(scaled, vertex, strict=True)) * table[row]
    return total


def test_values_are_sums_of_interpolated_levels() -> None:
    field = filled(density_shift=-0.3, density_scale=2.0)
    assert [tuple(levels.cells) for levels in field.levels] == CELLS
    positions, directions, times = some_points()
    output = field(positions, directions, times)
    for i, place in enumerate(positions.tolist()):
        density, *colors = looked_up([t.detach() for t in field.tables], place).tolist()
        assert float(output.density[i].detach()) == pytest.approx(math.log1p(math.exp(2 * density - 0.3)), rel=1e-12)
        x, y, z = directions[i].tolist()
        harmonics = [  # orthonormal on the sphere, without the constant: Sloan 2013
            -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x, 1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z, 0.31539156525252005 * (3 * z * z - 1), -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]  # fmt: skip
        terms = looked_up([t.detach() for t in field.harmonics], place).view(3, 8).tolist()
        for k in range(3):
            value = colors[k] + sum(c * h for c, h in zip(terms[k], harmonics, strict=True))
            assert float(output.rgb[i, k].detach()) == pytest.approx(1 / (1 + math.exp(-value)), rel=1e-12)


def crossings(start: np.ndarray, end: np.ndarray) -> list[float]:
    """Shares of a segment at which it crosses a face of any level's cells, with both ends."""
    shares = {0.0, 1.0}
    for cells, axis in itertools.product(CELLS, range(3)):
        for face in np.linspace(BOX[0][axis], BOX[1][axis], cells[axis] + 1):
            share = (face - start[axis]) / (end[axis] - start[axis])
            shares |= {float(share)} if 0 < share < 1 else set()
    return sorted(shares)


def exact_depth(tables: list[Tensor], start: np.ndarray, end: np.ndarray) -> float:
    """Integral over a segment of the tables' sum: each cell's cubic, written out and integrated term by term."""
    total, length = 0.0, float(np.linalg.norm(end - start))
    for a, b in itertools.pairwise(crossings(start, end)):
        for table, cells in zip(tables, CELLS, strict=True):
            values = dict(zip(rows_of(cells), table[:, 0].tolist(), strict=True))
            scale = np.array(cells) / (np.array(BOX[1]) - BOX[0])
            first, slope = (start - BOX[0]) * scale, (end - start) * scale
            cell = np.floor(first + slope * (a + b) / 2).astype(int)
            along = [Polynomial([f - c, s]) for f, c, s in zip(first, cell, slope, strict=True)]
            for corner in itertools.product((0, 1), repeat=3):
                weight = Polynomial([values[tuple(int(c + k) for c, k in zip(cell, corner, strict=True))]])
                for part, k in zip(along, corner, strict=True):
                    weight = weight * (part if k else 1 - part)
                integral = weight.integ()
                total += length * float(integral(b) - integral(a))
    return total


def test_optical_depth_is_that_of_the_cubics_in_the_cells() -> None:
    """Two Gauss-Legendre points in each cell against cubics that are written out, across the box.

    Above 20 torch's softplus is its argument: density is trilinear there.
    """
    field = filled(density_shift=0.0, density_scale=1.0)
    with torch.no_grad():
        for table in field.tables:
            table[:, 0] = table[:, 0].abs() + 10
    tables = [table.detach() for table in field.tables]
    generator = np.random.default_rng(2)
    low, high = np.array(BOX)
    for _ in range(5):
        start, end = low + (high - low) * generator.random((2, 3))
        shares = torch.tensor(crossings(start, end), dtype=torch.float64)
        middles, halves = (shares[1:] + shares[:-1]) / 2, shares.diff() / 2
        points = middles[:, None] + halves[:, None] * torch.tensor([-1.0, 1.0], dtype=torch.float64) / math.sqrt(3)
        places = torch.lerp(torch.tensor(start), torch.tensor(end), points[..., None])
        density = field.density(places, points).detach().mean(1)  # of intervals
        assert (density > 20).all()
        depth = float((density * shares.diff()).sum()) * float(np.linalg.norm(end - start))
        assert depth == pytest.approx(exact_depth(tables, start, end), rel=1e-10)


@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_gradients_are_those_of_finite_differences(activation: str) -> None:
    field = filled(density_activation=activation, window_end=0.5)
    field.set_progress(0.4)  # the last level is open in part
    positions, directions, times = some_points(4)
    names = [name for name, _ in field.named_parameters()]

    def of(positions: Tensor, directions: Tensor, *tables: Tensor) -> tuple[Tensor, Tensor]:
        values = dict(zip(names, tables, strict=True))
        output = torch.func.functional_call(field, values, (positions, directions, times))
        return output.density, output.rgb

    inputs = (positions.requires_grad_(), directions.requires_grad_(), *field.parameters())
    assert torch.autograd.gradcheck(of, inputs, fast_mode=True)


def test_levels_open_one_after_the_other() -> None:
    field = filled(window_end=0.5)
    cases = {0.0: [1, 0, 0], 0.125: [1, 0.5, 0], 0.25: [1, 1, 0], 0.5: [1, 1, 1], 1.0: [1, 1, 1]}
    for progress, expected in cases.items():
        field.set_progress(progress)
        assert field.window.tolist() == pytest.approx(expected, abs=1e-7)
        assert field.num_open == sum(share > 0 for share in expected)
    field.set_progress(0.125)
    points = some_points()
    here = field(*points)
    here.rgb.sum().backward()
    assert [t.grad is not None for t in (*field.tables, *field.harmonics)] == [True, True, False, True, True]
    other = filled(0.0, window_end=0.5)
    other.load_state_dict(field.state_dict())  # images of it before its first step
    assert torch.equal(other(*points).rgb, here.rgb)
    assert not any(table.count_nonzero() for table in VoxelField(BOX, window_end=0.5).tables)


def voxel_renderer() -> Renderer:
    box = [[-1.5] * 3, [1.5] * 3]
    sampler = OccupancySampler(OccupancyGrid(box, 8, num_slabs=2), 0.1, pad_to=64)
    field = DeformedField(IdentityDeformation(), VoxelField(box, (4, 8, 16), window_end=0.5))
    return Renderer(field, sampler, RandomBackground())


def test_a_run_is_continued_bit_by_bit_while_levels_open(tmp_path: Path) -> None:
    """The finest level has no moments at the checkpoint, and has them at the end."""
    frames, whole, again = small_frames(), voxel_renderer(), voxel_renderer()

    def trainer(work: Callable[[Run], None]) -> Trainer:
        callbacks = {"checkpoints": Checkpoints(1), "average": WeightAverage(every=3), "watch": Watch(work)}
        return small_trainer(num_steps=12, callbacks=callbacks)

    def stop(run: Run) -> None:
        opened.append(again.field.canonical.num_open)
        if run.step == 3:
            raise KeyboardInterrupt

    opened: list[int] = []
    trainer(lambda run: None).fit(whole, frames, seed=2, folder=tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        trainer(stop).fit(again, frames, seed=2, folder=tmp_path / "parts")
    assert opened == [1, 2, 2]
    again = voxel_renderer()
    trainer(lambda run: None).fit(again, frames, seed=3, folder=tmp_path / "parts", resume=True)
    assert again.field.canonical.num_open == 3
    assert torch.equal(weights(whole), weights(again))


def test_roughness_is_of_differences_between_neighbours() -> None:
    field = VoxelField(BOX, (4, 6, 40), view_degree=0).double()  # of the last level at some layers
    with torch.no_grad():
        for table, levels in zip(field.tables, field.levels, strict=True):
            x, y, z = torch.tensor(rows_of(tuple(levels.cells)), dtype=torch.float64).T
            table.copy_((0.5 * x - 2 * y + 3 * z)[:, None].expand(-1, 4))
    in_space, in_time = field.roughness()
    assert float(in_space.detach()) == pytest.approx(3 * (0.25 + 4 + 9))
    assert float(in_time.detach()) == 0


def test_roughness_looks_at_every_layer_in_its_turn_whatever_was_drawn_elsewhere() -> None:
    field = VoxelField(BOX, (40,), view_degree=0)
    (table,), (_, _, z) = field.tables, field.levels[0].cells
    counts = torch.zeros(z + 1)
    with torch.no_grad():
        table.copy_(torch.arange(4.0) * torch.arange(len(table))[:, None] ** 2)  # no layer without a gradient
    for turn in range(z + 2 - 16):  # layers at once
        table.grad = None
        field.roughness(torch.tensor(turn))[0].backward()
        assert table.grad is not None
        counts += table.grad.view(z + 1, -1).abs().sum(1) > 0
    assert counts.tolist() == [min(i + 1, z + 1 - i, 16, z + 2 - 16) for i in range(z + 1)]
    assert len({float(field.roughness(7)[0].detach()) for _ in range(9)}) == 1


@pytest.mark.parametrize(("settings", "message"), [
    ({"resolutions": ()}, "resolutions must ascend, one level at least, got []"),
    ({"resolutions": (8, 8)}, "resolutions must ascend, one level at least, got [8, 8]"),
    ({"resolutions": (8, 2.5)}, "resolutions must be a whole number, got 2.5"),
    ({"view_resolution": 16}, "view_resolution must be 32, the first level's, or more, got 16"),
    ({"view_degree": 5}, "view_degree must be one of 0, 1, 2, 3, 4; got 5"),
    ({"density_scale": 0}, "density_scale must be > 0 and finite, got 0"),
    ({"window_end": 0}, "window_end must be in (0, 1] or None, got 0"),
    ({"resolutions": (4096,), "view_degree": 0}, "resolutions [4096] need 1025.8 GiB in training, with gradients,"),
])  # fmt: skip
def test_bad_voxels_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ValueError) as error:
        VoxelField(BOX, **settings)
    assert str(error.value).startswith(message)
