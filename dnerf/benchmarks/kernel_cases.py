"""The work that `suite=kernels` times: every kernel on the samples of rays through an occupied spherical shell."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dnerf.benchmarks.network_cases import network_call, network_tracing_call
from dnerf.benchmarks.plain_kernels import corner_rows, plain_grid_encode, plain_packed_weights
from dnerf.benchmarks.suite import Settings
from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.geometry import cube_corners
from dnerf.kernels import (
    FrameTables,
    GridLevels,
    MarchedSamples,
    add_seen,
    brick_lookup,
    covered_places,
    few_nonzero,
    footprints,
    grid_encode,
    lattice_places,
    march,
    march_to_size,
    packed_sum,
    packed_weights,
    relu_layers,
    seen_parts,
    shade,
    skip_distances,
    thin_out,
    trace,
    use_backend,
)
from dnerf.kernels.brick_lookup import BRICK, VERTICES
from dnerf.kernels.trace import NUM_STATES
from dnerf.rays import Rays

COMPILED = "compiled"
REFERENCE = "reference"
PLAIN = "plain torch"
RESOLUTIONS = (16, 32, 64, 128)
NUM_FEATURES = 8
MAX_ROWS = 1 << 17
STEP = 0.03
SPACING = 0.06  # along a ray, of samples whose deformation is asked
WIDTHS = (32, 128, 128, 128, 128)  # of the network of a deformation
LATTICE = 384  # cells per side of the bricks' lattice
CONTENTS = 16  # numbers of each of its vertices
DISPLACEMENTS = 80  # cells per side of the displacements' lattice

Call = Callable[[], Any]


@dataclass(frozen=True)
class Case:
    """One kernel at work.

    Args:
        kernel: its name.
        direction: "forward" or "forward + backward".
        calls: what to time, by variant; `COMPILED` and `REFERENCE` among them.
        num_bytes: read and written at the very least: inputs, outputs and table rows that are used, once each.
    """

    kernel: str
    direction: str
    calls: dict[str, Call]
    num_bytes: float


class Workload:
    """Rays, occupancy, grid and samples that all kernels are timed on.

    Args:
        num_rays: R.
        settings: seed and device.
    """

    def __init__(self, num_rays: int, settings: Settings) -> None:
        generator = torch.Generator().manual_seed(settings.seed)
        device = settings.device
        origins = torch.nn.functional.normalize(torch.randn(num_rays, 3, generator=generator), dim=-1) * 4
        targets = 2 * torch.rand(num_rays, 3, generator=generator) - 1
        directions = torch.nn.functional.normalize(targets - origins, dim=-1)
        times = torch.rand(num_rays, generator=generator)
        near = torch.full((num_rays,), 2.0)
        self.rays = Rays(origins, directions, times, near, near + 4).to(device)
        self.jitter = torch.rand(num_rays, generator=generator).to(device)
        axis = (torch.arange(64, device=device) + 0.5) / 32 - 1
        radius = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0) * 1.5
        self.occupancy = ((radius > 0.7) & (radius < 0.9)).expand(16, 64, 64, 64).contiguous()
        self.skips = skip_distances(self.occupancy)
        self.box = torch.tensor([[-1.5] * 3, [1.5] * 3], device=device)
        self.marched = self._march(self.jitter)
        self.num_samples = len(self.marched.starts)
        self.points = self._middles(self.marched)
        self.positions = (self.points / 3 + 0.5).contiguous()
        self.levels = GridLevels(RESOLUTIONS, MAX_ROWS)
        self.table = torch.randn(self.levels.num_rows, NUM_FEATURES, generator=generator).to(device)
        self.cells = self.positions * LATTICE
        traced = self._middles(self._march(torch.zeros_like(self.jitter)))
        self.traced_cells = (traced / 3 + 0.5) * LATTICE
        side = LATTICE // BRICK
        needed = (torch.cat([self.cells, self.traced_cells]) / BRICK).long().clamp(0, side - 1)
        self.slots = torch.full((side,) * 3, -1, device=device)
        self.slots[needed.unbind(-1)] = 0
        places = (self.slots == 0).nonzero()
        self.slots[places.unbind(-1)] = torch.arange(len(places), device=device)
        self.bricks = torch.randn(len(places), VERTICES, CONTENTS, generator=generator).half().to(device)
        self.depth = torch.rand(self.num_samples, generator=generator).to(device)
        self.values = torch.rand(self.num_samples, 5, generator=generator).to(device)
        self.weights = packed_weights(self.depth, self.marched.offsets)
        self.inputs = torch.randn(self.num_samples, WIDTHS[0], generator=generator).to(device)
        self.layers = [
            torch.randn(*shape, generator=generator).to(device) / shape[-1] ** 0.5
            for shape in (*zip(WIDTHS[1:], WIDTHS[:-1], strict=True), *((w,) for w in WIDTHS[1:]))
        ]

    def _middles(self, marched: MarchedSamples) -> Tensor:
        middles, index = 0.5 * (marched.starts + marched.ends)[:, None], marched.ray_indices
        return self.rays.origins[index] + middles * self.rays.directions[index]

    def _march(self, jitter: Tensor) -> MarchedSamples:
        r = self.rays
        return march(
            r.origins, r.directions, r.near, r.far, times=r.times, jitter=jitter, occupancy=self.occupancy,
            aabb=self.box, step=STEP, skips=self.skips,
        )  # fmt: skip

    def _contents_bytes(self, cells: Tensor) -> int:
        """What the bricks hold at the vertices of the cells (N, 3) of places in them."""
        x, y, z = (cells.long()[:, None] + cube_corners(cells.device)).unbind(-1)
        vertices = torch.unique((x * (LATTICE + 1) + y) * (LATTICE + 1) + z)
        return self.bricks.element_size() * CONTENTS * vertices.numel()

    def cases(self) -> list[Case]:
        """All kernels, forward and (where there is one) backward."""
        offsets, n = self.marched.offsets, 4 * self.num_samples
        used_rows = sum(int(torch.unique(rows).numel()) for rows, _ in corner_rows(self.positions, self.levels))
        features = self.levels.num_levels * NUM_FEATURES
        grid_bytes = 3 * n + 4 * NUM_FEATURES * used_rows + features * n
        # Backward: the features' gradient and the positions again, the rows again, both gradients written.
        grid_back = grid_bytes + features * n + 6 * n + 4 * NUM_FEATURES * used_rows + self.table.nbytes
        out = 5 * 4 * len(self.rays)
        cases = [
            Case("march", "forward", _backends(lambda: self._march(self.jitter)), self._marching_bytes()),
            Case(
                "brick_lookup",
                "forward",
                _backends(lambda: brick_lookup(self.cells, self.slots, self.bricks)),
                (4 * (3 + CONTENTS) + 1) * self.num_samples + self._contents_bytes(self.cells),
            ),
            *_both(
                "grid_encode",
                lambda p, t: grid_encode(p, t, self.levels),
                lambda p, t: plain_grid_encode(p, t, self.levels),
                (self.positions, self.table),
                (grid_bytes, grid_back),
            ),
            *_both(
                "packed_weights",
                lambda d: packed_weights(d, offsets),
                lambda d: plain_packed_weights(d, self.marched.ray_indices, offsets),
                (self.depth,),
                (2 * n, 6 * n),
            ),
            *_both(
                "packed_sum",
                lambda v, w: packed_sum(v, w, offsets),
                lambda v, w: torch.segment_reduce(v * w[:, None], "sum", offsets=offsets, axis=0),
                (self.values, self.weights),
                (6 * n + out, 18 * n + 2 * out),
            ),
        ]
        return cases + (self._compiled_on_gpus_alone() if self.points.is_cuda else self._compiled_on_cpus_alone())

    def _marching_bytes(self) -> int:
        return 40 * len(self.rays) + (4 + 4 + 8) * self.num_samples

    def _compiled_on_gpus_alone(self) -> list[Case]:
        """Kernels that CPUs run by their definition."""
        r, step = self.rays, torch.tensor(STEP, device=self.points.device)
        to_size = partial(
            march_to_size, r.origins, r.directions, r.near, r.far, times=r.times, jitter=self.jitter,
            occupancy=self.occupancy, aabb=self.box, step=step, size=self.num_samples,
        )  # fmt: skip
        return [Case("march_to_size", "forward", _backends(to_size), self._marching_bytes())]

    def _compiled_on_cpus_alone(self) -> list[Case]:
        """Kernels that GPUs run by their definition."""
        n, contents = 4 * self.num_samples, self._contents_bytes(self.traced_cells)
        occupied = self.occupancy[0]
        cells = torch.stack(torch.unravel_index(few_nonzero(occupied), occupied.shape))
        # Vertices of the displacements' lattice around them.
        lows, ends = cells * DISPLACEMENTS // len(occupied), -(-(cells + 1) * DISPLACEMENTS // len(occupied)) + 1
        around = covered_places(lows, ends, (DISPLACEMENTS + 1,) * 3)
        camera = Camera(Intrinsics.from_angle(400, 400, 0.7), look_at((2.5, 2.5, 1.5)))
        view = partial(footprints, occupied, self.box, camera.pose, camera.intrinsics.lens, (400, 400))
        covered = view()
        seen = 0 if covered is None else len(covered.pixels)
        times = self.rays.times[self.marched.ray_indices]
        side, r, found = DISPLACEMENTS + 1, self.rays, self.marched
        low, sides = self.box[0], self.box[1] - self.box[0]
        middles = 0.5 * (found.starts + found.ends)
        places = partial(
            lattice_places, r.origins, r.directions, found.ray_indices, middles, torch.zeros(side**3, 4), (side,) * 3,
            low, sides,
        )  # fmt: skip
        thin, light = torch.full_like(middles, 5.0), torch.ones_like(r.near)
        parts = partial(
            seen_parts, found.starts, found.ends, found.offsets, thin, light, splits=3, split_weight=0.02,
            min_weight=4e-3,
        )  # fmt: skip
        colors, sums, numbers = (
            torch.rand(len(middles), 3),
            torch.zeros(len(self.rays), 5),
            torch.arange(len(self.rays)),
        )
        adding = partial(add_seen, sums, numbers, light, found.starts, found.ends, found.offsets, thin, colors)
        products = torch.randn(self.num_samples, 4).bfloat16()
        layers = sum(x.nbytes for x in self.layers) // 2
        activations = self.num_samples * (2 * WIDTHS[0] + 2 * WIDTHS[-1])
        rows = (torch.unique(rows).numel() for rows, _ in corner_rows(self.positions, self.levels))
        used = 4 * NUM_FEATURES * sum(rows)
        network_tracer = network_tracing_call(
            self.rays, (self.occupancy[0], self.skips[0], self.box), (self.table, self.levels), DISPLACEMENTS + 1, STEP
        )
        return [
            Case("thin_out", "forward", _backends(lambda: thin_out(self.points, times, SPACING)), (4 + 2 + 1 + 1) * n),
            Case(
                "skip_distances",
                "forward",
                _backends(lambda: skip_distances(self.occupancy)),
                self.occupancy.nbytes + self.skips.nbytes,
            ),
            Case(
                "few_nonzero",
                "forward",
                _backends(lambda: few_nonzero(occupied)) | {PLAIN: lambda: occupied.view(-1).nonzero()[:, 0]},
                occupied.nbytes + 8 * cells.shape[1],
            ),
            Case(
                "covered_places",
                "forward",
                _backends(lambda: covered_places(lows, ends, (DISPLACEMENTS + 1,) * 3)),
                lows.nbytes + ends.nbytes + around.nbytes,
            ),
            Case("lattice_places", "forward", _backends(places), (2 + 1 + 3) * n),
            Case("seen_parts", "forward", _backends(parts), 3 * n + 16 * self.num_samples),
            Case("add_seen", "forward", _backends(adding), 6 * n + 2 * sums.nbytes),
            Case("shade", "forward", _backends(lambda: shade(products, torch.zeros(4), -1.0)), 24 * self.num_samples),
            Case("footprints", "forward", _backends(view), occupied.nbytes + 16 * seen),
            Case("trace", "forward", _backends(self._tracer()), 10 * 4 * len(self.rays) + contents),
            Case(
                "grid_network",
                "forward",
                _backends(network_call(self.positions, self.table, self.levels)),
                3 * n + self.num_samples * 4 * 4 + used,
            ),
            Case("trace_network", "forward", _backends(network_tracer), 10 * 4 * len(self.rays) + used),
            *_both(
                "relu_layers",
                _in_bfloat16,
                None,
                (self.inputs, *self.layers),
                (activations + layers, 3 * activations + 3 * layers),
            ),
        ]

    def _tracer(self) -> Call:
        """Following the rays through all their bricks: matter is thin, displacements are zero and steps stay whole."""
        side = DISPLACEMENTS + 1
        low, sides = self.box[0], self.box[1] - self.box[0]
        tables = FrameTables(
            occupancy=self.occupancy[0], skips=self.skips[0], aabb=self.box, low=low, sides=sides, slots=self.slots,
            displacements=torch.zeros(side**3, 4), is_known=torch.ones(side, side, side, dtype=torch.bool),
            bricks=self.bricks, brick_low=low, waves=torch.ones(CONTENTS // 4),
        )  # fmt: skip
        states = torch.zeros(len(self.rays), NUM_STATES)
        states[:, 0] = 1
        numbers, r = torch.zeros(len(self.rays), dtype=torch.int64), self.rays
        return lambda: trace(
            r.origins, r.directions, r.near, r.far, states, numbers, tables, step=STEP, splits=1, min_weight=0.0,
            split_weight=0.0, cells_per_unit=LATTICE / float(sides[0]), log_shift=-10.0, stop_transmittance=1e-4,
        )  # fmt: skip


def _in_bfloat16(inputs: Tensor, *parameters: Tensor) -> Tensor:
    """`relu_layers` as a network in bfloat16 has them: of all weights, then all biases."""
    half = len(parameters) // 2
    with torch.autocast(inputs.device.type, torch.bfloat16):
        return relu_layers(inputs, parameters[:half], parameters[half:])


def _backends(call: Call) -> dict[str, Call]:
    def by_definition() -> Any:
        with use_backend("reference"):
            return call()

    return {COMPILED: call, REFERENCE: by_definition}


def _both(
    kernel: str,
    function: Callable[..., Tensor],
    plain: Callable[..., Tensor] | None,
    inputs: Sequence[Tensor],
    num_bytes: tuple[float, float],
) -> list[Case]:
    """A differentiable kernel's two cases; without a plain form where the definition is the quickest."""
    leaves = [x.detach().clone().requires_grad_() for x in inputs]

    def forward(op: Callable[..., Tensor]) -> Call:
        def call() -> Tensor:
            with torch.no_grad():
                return op(*inputs)

        return call

    def backward(op: Callable[..., Tensor]) -> Call:
        def call() -> Any:
            out = op(*leaves)
            return torch.autograd.grad(out, leaves, torch.ones_like(out))

        return call

    ways = (("forward", forward, num_bytes[0]), ("forward + backward", backward, num_bytes[1]))
    return [
        Case(kernel, name, _backends(way(function)) | ({} if plain is None else {PLAIN: way(plain)}), size)
        for name, way, size in ways
    ]
