"""The work that `suite=kernels` times: every kernel on the samples of rays through an occupied spherical shell."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.plain_kernels import corner_rows, plain_grid_encode, plain_packed_weights
from benchmarks.suite import Settings
from dnerf.core.rays import Rays
from dnerf.kernels import (
    GridLevels,
    MarchedSamples,
    grid_encode,
    grid_network,
    march,
    march_to_size,
    packed_sum,
    packed_weights,
    relu_layers,
    series_sums,
    skip_distances,
    use_backend,
)

COMPILED = "compiled"
REFERENCE = "reference"
PLAIN = "plain torch"
RESOLUTIONS = (16, 32, 64, 128)
NUM_FEATURES = 8
MAX_ROWS = 1 << 17
STEP = 0.03
WIDTHS = (32, 128, 128, 128, 128)  # of the network of a deformation
SERIES = (4 + 3 * 12, 12)  # coefficients of density and colours, and functions of time and direction
HEAD = (len(RESOLUTIONS) * NUM_FEATURES, 64, 64, 4)  # of the network behind a grid's features

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

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator)

        def uniform(*shape: int) -> Tensor:
            return torch.rand(*shape, generator=generator)

        origins, targets = 4 * normalize(normal(num_rays, 3), dim=-1), 2 * uniform(num_rays, 3) - 1
        near = torch.full((num_rays,), 2.0)
        directions = normalize(targets - origins, dim=-1)
        self.rays = Rays(origins, directions, uniform(num_rays), near, near + 4).to(device)
        self.jitter = uniform(num_rays).to(device)
        axis = (torch.arange(64, device=device) + 0.5) / 32 - 1
        radius = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0) * 1.5
        self.occupancy = ((radius > 0.7) & (radius < 0.9)).expand(16, 64, 64, 64).contiguous()
        self.skips = skip_distances(self.occupancy)
        self.box = torch.tensor([[-1.5] * 3, [1.5] * 3], device=device)
        self.marched = self.march()
        self.num_samples = len(self.marched.starts)
        self.distances = 0.5 * (self.marched.starts + self.marched.ends)
        index = self.marched.ray_indices
        self.points = self.rays.origins[index] + self.distances[:, None] * self.rays.directions[index]
        self.positions = (self.points / 3 + 0.5).contiguous()
        self.levels = GridLevels(RESOLUTIONS, MAX_ROWS)
        self.table = normal(self.levels.num_rows, NUM_FEATURES).to(device)
        self.used_bytes = 4 * NUM_FEATURES * sum(
            int(torch.unique(rows).numel()) for rows, _ in corner_rows(self.positions, self.levels)
        )  # fmt: skip
        self.depth = uniform(self.num_samples).to(device)
        self.values = uniform(self.num_samples, 5).to(device)
        self.inputs = normal(self.num_samples, WIDTHS[0]).to(device)
        self.layers = [layer.to(device) for layer in _layers(WIDTHS, normal)]
        self.head = [layer.to(device) for layer in _layers(HEAD, normal)]
        self.series = normal(self.num_samples, sum(SERIES)).to(device)

    def march(self) -> MarchedSamples:
        """The samples of all rays."""
        r = self.rays
        return march(
            r.origins, r.directions, r.near, r.far, times=r.times, jitter=self.jitter, occupancy=self.occupancy,
            aabb=self.box, step=STEP, skips=self.skips,
        )  # fmt: skip

    def march_to_size(self) -> Any:
        """The same in as many places as there are samples."""
        r = self.rays
        return march_to_size(
            r.origins, r.directions, r.near, r.far, times=r.times, jitter=self.jitter, occupancy=self.occupancy,
            aabb=self.box, step=torch.tensor(STEP, device=self.box.device), size=self.num_samples,
        )  # fmt: skip


def training_cases(work: Workload) -> list[Case]:
    """Kernels of training steps, forward and (where there is one) backward; only those that a device compiles."""
    n, marching_bytes = 4 * work.num_samples, 40 * len(work.rays) + 16 * work.num_samples
    cases = [
        Case("march", "forward", backends(work.march), marching_bytes),
        *_grid_cases(work, n),
        *_packed_cases(work, n),
    ]
    if work.points.is_cuda:
        return [*cases, Case("march_to_size", "forward", backends(work.march_to_size), marching_bytes)]
    skips_bytes = work.occupancy.nbytes + work.skips.nbytes
    return [
        *cases,
        *_network_cases(work, n),
        Case("skip_distances", "forward", backends(partial(skip_distances, work.occupancy)), skips_bytes),
    ]


def _grid_cases(work: Workload, n: int) -> list[Case]:
    features = work.levels.num_levels * NUM_FEATURES
    forward = 3 * n + work.used_bytes + features * n
    # Backward: the features' gradient and the positions again, the rows again, both gradients written.
    backward = forward + features * n + 6 * n + work.used_bytes + work.table.nbytes
    return _both(
        "grid_encode", lambda p, t: grid_encode(p, t, work.levels), lambda p, t: plain_grid_encode(p, t, work.levels),
        (work.positions, work.table), (forward, backward),
    )  # fmt: skip


def _packed_cases(work: Workload, n: int) -> list[Case]:
    offsets, out = work.marched.offsets, 20 * len(work.rays)
    weights = packed_weights(work.depth, offsets)
    return [
        *_both(
            "packed_weights", lambda d: packed_weights(d, offsets),
            lambda d: plain_packed_weights(d, work.marched.ray_indices, offsets), (work.depth,), (2 * n, 6 * n),
        ),
        *_both(
            "packed_sum", lambda v, w: packed_sum(v, w, offsets),
            lambda v, w: torch.segment_reduce(v * w[:, None], "sum", offsets=offsets, axis=0),
            (work.values, weights), (6 * n + out, 18 * n + 2 * out),
        ),
    ]  # fmt: skip


def _network_cases(work: Workload, n: int) -> list[Case]:
    layers = sum(x.nbytes for x in work.layers) // 2
    activations = work.num_samples * (2 * WIDTHS[0] + 2 * WIDTHS[-1])
    weights, biases = work.head[: len(work.head) // 2], work.head[len(work.head) // 2 :]

    def evaluate() -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            return grid_network(work.positions, work.table, work.levels, weights, biases)

    return [
        Case("grid_network", "forward", backends(evaluate), 3 * n + 4 * n + work.used_bytes),
        *_both(
            "relu_layers", _in_bfloat16, None, (work.inputs, *work.layers),
            (activations + layers, 3 * activations + 3 * layers),
        ),
        *_both(
            "series_sums", series_sums, None, [x.contiguous() for x in work.series.split(SERIES, dim=1)],
            (n * (sum(SERIES) + 4), n * (3 * sum(SERIES) + 4)),
        ),
    ]  # fmt: skip


def _layers(widths: Sequence[int], normal: Callable[..., Tensor]) -> list[Tensor]:
    """All weights of a network, then all biases."""
    shapes = [*zip(widths[1:], widths[:-1], strict=True), *((width,) for width in widths[1:])]
    return [normal(*shape) / shape[-1] ** 0.5 for shape in shapes]


def _in_bfloat16(inputs: Tensor, *parameters: Tensor) -> Tensor:
    """`relu_layers` as a network in bfloat16 has them."""
    half = len(parameters) // 2
    with torch.autocast(inputs.device.type, torch.bfloat16):
        return relu_layers(inputs, parameters[:half], parameters[half:])


def backends(call: Call) -> dict[str, Call]:
    """A call by the compiled kernel and by its definition."""

    def by_definition() -> Any:
        with use_backend("reference"):
            return call()

    return {COMPILED: call, REFERENCE: by_definition}


def _both(
    kernel: str, function: Callable[..., Tensor], plain: Callable[..., Tensor] | None, inputs: Sequence[Tensor],
    num_bytes: tuple[float, float],
) -> list[Case]:  # fmt: skip
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
        Case(kernel, name, backends(way(function)) | ({} if plain is None else {PLAIN: way(plain)}), size)
        for name, way, size in ways
    ]
