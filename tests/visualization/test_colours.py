import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from dnerf.visualization.colours import COLORMAPS, UNKNOWN, colorize, flow_colors, flow_image, scaled_image, value_range


@pytest.mark.parametrize("colormap", COLORMAPS)
def test_colours_are_matplotlibs(colormap: str) -> None:
    matplotlib = pytest.importorskip("matplotlib", reason="needs the extra: pip install 'dnerf[report]'")
    values = torch.linspace(0, 1, 256)
    expected = matplotlib.colormaps[colormap](values.numpy())[:, :3]
    np.testing.assert_allclose(colorize(3 + 2 * values, 3, 5, colormap), expected, atol=0.03)


def test_numbers_outside_the_range_get_the_ends() -> None:
    ends = colorize(torch.tensor([0.0, 1.0]), 0, 1)
    assert torch.equal(colorize(torch.tensor([-5.0, 7.0]), 0, 1), ends)
    assert ends[0].tolist() == pytest.approx([0x44 / 255, 0x01 / 255, 0x54 / 255])


def test_range_leaves_outliers_and_masked_numbers_out() -> None:
    values = torch.linspace(1, 2, 1001)
    values[0], values[-1] = -1e6, 1e6
    low, high = value_range(values, torch.ones(1001, dtype=torch.bool))
    assert 1 < low < 1.01
    assert 1.99 < high < 2
    assert value_range(values, values == 1e6) == (1e6, 1e6)
    assert all(math.isnan(v) for v in value_range(values, values > 1e7))


def brute_force_wheel(x: float, y: float) -> list[float]:
    """colorcode.cpp of Baker et al., transcribed: makecolorwheel and computeColor."""
    ry, yg, gc, cb, bm, mr = 15, 6, 4, 11, 13, 6
    wheel = [(255, 255 * i // ry, 0) for i in range(ry)]
    wheel += [(255 - 255 * i // yg, 255, 0) for i in range(yg)]
    wheel += [(0, 255, 255 * i // gc) for i in range(gc)]
    wheel += [(0, 255 - 255 * i // cb, 255) for i in range(cb)]
    wheel += [(255 * i // bm, 0, 255) for i in range(bm)]
    wheel += [(255, 0, 255 - 255 * i // mr) for i in range(mr)]
    radius = math.sqrt(x * x + y * y)
    fk = (math.atan2(-y, -x) / math.pi + 1) / 2 * (len(wheel) - 1)
    k0 = int(fk)
    f = fk - k0
    color = [(1 - f) * a / 255 + f * b / 255 for a, b in zip(wheel[k0], wheel[(k0 + 1) % len(wheel)])]
    return [1 - radius * (1 - c) if radius <= 1 else 0.75 * c for c in color]


def test_wheel_agrees_with_its_source() -> None:
    generator = torch.Generator().manual_seed(1)
    flow = 2.4 * torch.rand(300, 2, generator=generator) - 1.2
    expected = [brute_force_wheel(x, y) for x, y in flow.tolist()]
    np.testing.assert_allclose(flow_colors(5 * flow, 5), expected, atol=1e-4)


def test_rest_is_white_and_unknown_is_grey() -> None:
    colors = flow_colors(torch.tensor([[0.0, 0.0], [math.nan, 0.0], [1.0, 0.0], [0.0, 1.0]]), 1)
    assert colors[0].tolist() == [1, 1, 1]
    assert colors[1].tolist() == [UNKNOWN] * 3
    assert colors[2].tolist() == pytest.approx([1, 0, 0], abs=0.2)  # right is red
    assert colors[3, 0] > 0.9
    assert colors[3, 1] > 0.8  # down is yellow
    assert colors[3, 2] < 0.1


@pytest.mark.parametrize("size", [(8, 9), (40, 60), (401, 300)])
def test_images_with_keys_keep_the_image_and_are_even(size: tuple[int, int]) -> None:
    values, opacity = torch.rand(size), torch.ones(size)
    image = scaled_image(values, opacity, 0, 1, label="depth")
    assert image.dtype == torch.uint8
    assert image.shape[0] == size[0]
    assert image.shape[1] % 2 == 0
    expected = (colorize(values, 0, 1) * 255).round().byte()
    # fading by opacity 1 rounds: one level
    assert (image[:, : size[1]].int() - expected.int()).abs().max() <= 1
    assert (image[:, size[1] :] < 128).any()  # the bar and its numbers
    flow = torch.randn(*size, 2)
    drawn = flow_image(flow, 2.0)
    assert torch.equal(drawn[:, : size[1]], (flow_colors(flow, 2.0) * 255).round().byte())
    assert drawn.shape[1] % 2 == 0


def test_bar_runs_from_low_at_the_bottom_to_high_at_the_top_beside_white_for_transparent() -> None:
    image = scaled_image(torch.ones(200, 10), torch.zeros(200, 10), 2.0, 6.0)
    assert (image[:, :10] == 255).all()
    panel = image[:, 10:]
    gap, thickness = 4, 8
    column = panel[:, gap + thickness // 2].float() / 255
    low, high = colorize(torch.tensor([2.0, 6.0]), 2, 6)
    coloured = (column.amax(-1) - column.amin(-1) > 0.1).nonzero()[:, 0]
    torch.testing.assert_close(column[coloured[0]], high, rtol=0, atol=0.03)
    torch.testing.assert_close(column[coloured[-1]], low, rtol=0, atol=0.03)


EMPTY = "low and high must be finite with low < high"


@pytest.mark.parametrize(
    ("draw", "shape", "arguments", "message"),
    [
        (flow_image, (4, 4, 3), [1.0], r"flow must have shape \(H, W, 2\)"),
        (flow_colors, (4, 2), [0.0], "max_length be > 0"),
        (scaled_image, (4, 4), [torch.zeros(4, 5), 0, 1], r"opacity must have shape \(4, 4\)"),
        (colorize, (3,), [0, 1, "jet"], "colormap must be one of inferno, viridis"),
        *((colorize, (3,), ends, EMPTY) for ends in ([0, 0], [1, 0], [0, math.inf], [math.nan, 1])),
    ],
)
def test_what_does_not_fit_is_named(draw: Callable, shape: tuple[int, ...], arguments: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        draw(torch.zeros(shape), *arguments)
