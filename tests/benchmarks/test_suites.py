"""Every suite runs at its quick size and says what it should; slow, but for those of a few seconds."""

import math

import pytest
import torch
from kernels.backends import serve_bfloat16

from benchmarks import Settings, run_suite
from benchmarks.kernel_cases import RESOLUTIONS
from benchmarks.machine import Rates
from benchmarks.operations import LAYER, OperationCounter
from benchmarks.plain_kernels import plain_grid_encode, plain_packed_weights
from benchmarks.profile import PARTS
from benchmarks.quadrature import samples_needed
from benchmarks.smooth import SmoothClouds, exact_smooth
from dnerf.core.rays import Rays
from dnerf.kernels import GridLevels, grid_encode, grid_network, is_bfloat16_wanted, packed_weights, relu_layers

RATES = Rates({torch.float32: 1e9}, bandwidth=1e9, cached_bandwidth=1e9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["flow", "kernels", "quadrature"])
def test_suite_runs_at_its_quick_size(name):
    result = run_suite(name, Settings(quick=True))
    assert result.findings
    assert all(table.rows for table in result.tables)
    assert all(plot.title and plot.x_label for plot in result.plots)


def test_plain_forms_that_kernels_are_compared_with_agree_with_them():
    levels = GridLevels(RESOLUTIONS, 1 << 12)
    positions, table = torch.rand(500, 3), torch.randn(levels.num_rows, 8)
    expected = grid_encode(positions, table, levels)
    # Three weights are multiplied in another order, on cells of up to 128 a side.
    torch.testing.assert_close(plain_grid_encode(positions, table, levels), expected, rtol=0, atol=1e-4)
    offsets = torch.tensor([0, 3, 3, 10])
    depth = torch.rand(10)
    weights = plain_packed_weights(depth, torch.tensor([0] * 3 + [2] * 7), offsets)
    torch.testing.assert_close(weights, packed_weights(depth, offsets))


def test_operations_are_counted_with_their_bytes_and_products():
    a, b = torch.rand(8, 16, requires_grad=True), torch.rand(16, 4)
    counter = OperationCounter(RATES)
    with counter:
        (a @ b).relu().sum().backward()
    mm = counter.work["aten::mm"]
    assert mm.calls == 2  # the second is a's gradient
    assert mm.flops == 2 * 2 * 8 * 16 * 4
    assert mm.num_bytes == 2 * 4 * (8 * 16 + 16 * 4 + 8 * 4)
    assert mm.seconds == pytest.approx(max(mm.flops, mm.num_bytes) / 1e9)
    relu = counter.work["aten::relu"]
    assert relu.num_bytes == 2 * 4 * 8 * 4


def test_products_of_fused_layers_are_counted():
    inputs = torch.rand(32, 16)
    weights, biases = [torch.rand(24, 16), torch.rand(8, 24)], [torch.rand(24), torch.rand(8)]
    counter = OperationCounter(RATES)
    with counter, torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        if not is_bfloat16_wanted(inputs):
            pytest.skip("oneDNN has no bfloat16 on this processor")
        relu_layers(inputs, weights, biases)
    assert counter.work[LAYER].calls == 2  # of widths that no kernel for vectors serves
    assert counter.work[LAYER].flops == 2 * 32 * (16 * 24 + 24 * 8)


def test_products_of_whole_networks_are_counted(monkeypatch):
    serve_bfloat16(monkeypatch)
    levels = GridLevels((4, 8), 1 << 12)
    weights, biases = [torch.rand(32, 16), torch.rand(16, 32), torch.rand(4, 16)], [torch.rand(n) for n in (32, 16, 4)]
    counter = OperationCounter(RATES)
    with counter, torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        relu_layers(torch.rand(40, 16), weights[:2], biases[:2])
        grid_network(torch.rand(70, 3), torch.rand(levels.num_rows, 8), levels, weights, biases)
    assert counter.work["dnerf::relu_layers"].flops == 2 * 40 * (16 * 32 + 32 * 16)
    assert counter.work["dnerf::grid_network"].flops == 2 * 70 * (16 * 32 + 32 * 16 + 16 * 4)
    assert LAYER not in counter.work


def test_profile_names_the_part_of_every_kernel_that_training_runs():
    kernels = {name for name in torch._C._dispatch_get_all_op_names() if name.startswith("dnerf::")}
    named = {name for names in PARTS.values() for name in names}
    assert kernels
    assert kernels <= named


def test_updates_in_place_are_written_and_views_are_free():
    x = torch.zeros(100)
    counter = OperationCounter(RATES)
    with counter:
        x.view(10, 10).t()
        x.add_(1.0)
        x.expand(50, 100).sum()
    assert counter.work["aten::add_"].num_bytes == 2 * 400
    assert set(counter.work) == {"aten::add_", "aten::sum"}
    assert counter.work["aten::sum"].num_bytes == 404  # an expanded tensor's memory is read once


@pytest.mark.parametrize(
    ("errors", "expected"),
    [([1.0, 0.1, 0.01], 10 * math.sqrt(10)), ([0.01, 0.001, 0.0001], 1.0), ([1.0] * 3, math.inf)],
)
def test_samples_needed_are_read_off_the_curve(errors, expected):
    rows = [{"samples_per_ray": n, "rms_error": e} for n, e in zip((1, 10, 100), errors)]
    assert samples_needed(rows, 0.1 / math.sqrt(10)) == pytest.approx(expected)


def test_truth_of_smooth_clouds_agrees_with_many_samples():
    generator = torch.Generator().manual_seed(0)
    origins = 4 * torch.nn.functional.normalize(torch.randn(20, 3, generator=generator, dtype=torch.float64), dim=-1)
    targets = torch.rand(20, 3, generator=generator, dtype=torch.float64) - 0.5
    one = torch.ones(20, dtype=torch.float64)
    rays = Rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1), 0.3 * one, 2 * one, 6 * one)
    field = SmoothClouds()
    truth, bound = exact_smooth(field, rays)
    assert bound < 1e-9
    t = torch.linspace(2, 6, 40001, dtype=torch.float64)
    middles = 0.5 * (t[1:] + t[:-1])
    color = torch.zeros(20, 3, dtype=torch.float64)
    left = torch.ones(20, dtype=torch.float64)
    for part in middles.split(2000):
        x = rays.origins[:, None] + part[:, None] * rays.directions[:, None]
        output = field(x, x, rays.times[:, None].expand(20, len(part)))
        depth = output.density * (t[1] - t[0])
        before = torch.exp(-(depth.cumsum(-1) - depth)) * left[:, None]
        color += ((before * -torch.expm1(-depth))[..., None] * output.rgb).sum(1)
        left = left * torch.exp(-depth.sum(-1))
    # The box ends at 1.6, beyond which the clouds are thinner than 1e-4.
    torch.testing.assert_close(truth, color + left[:, None], rtol=0, atol=1e-4)
