"""Textures: colours stay in range, boards alternate, breaks lie where colours jump."""

import math

import pytest
import torch

from dnerf.scenes import Ball, Box, Checker, Glossy, Glow, Gradient, Lit, Plain, Shadowed, Shape, Stripes, Texture
from dnerf.scenes.textures import grid_planes, sector_planes

BLACK, WHITE = Plain((0.0, 0.0, 0.0)), Plain((1.0, 1.0, 1.0))
BOARD = Checker(BLACK, WHITE, grid_planes(0.25, 3))
TEXTURES: list[Texture] = [
    WHITE, Gradient((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), Glow((1.0, 0.5, 0.0), (0.0, 0.5, 1.0), 1.0),
    Stripes(BLACK, WHITE, (0.0, 30.0, 0.0)), BOARD, Lit(WHITE),
    Shadowed(WHITE, ((0.1, 0.2, 0.3), (0.2, 0.1, 0.3)), 1.0), Glossy(Lit(WHITE), strength=1.0),
    Glossy(BLACK, strength=1.0),
]  # fmt: skip


def inside_unit_ball(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    unit = torch.nn.functional.normalize(torch.randn(2, count, 3, dtype=torch.float64), dim=-1)
    return unit[0] * torch.rand(count, 1, dtype=torch.float64), unit[1]


@pytest.mark.parametrize("texture", TEXTURES, ids=lambda t: type(t).__name__)
@pytest.mark.parametrize("shape", [Ball(1.0), Box((1.0, 1.0, 1.0))], ids=str)
def test_colors_stay_in_range(texture: Texture, shape: Shape) -> None:
    points, directions = inside_unit_ball(5000)
    color = texture.color(points, shape.normals(points), directions)
    assert color.shape == points.shape
    assert ((color >= 0) & (color <= 1)).all()


def test_board_alternates_between_neighbouring_cells() -> None:
    cells = torch.cartesian_prod(*[torch.arange(-4, 4)] * 3)
    points = 0.25 * (cells + 0.5).double()
    color = BOARD.color(points, points, points)[:, 0]
    parity = cells.sum(-1) % 2
    assert (color == color[0]).eq(parity == parity[0]).all()


def test_sectors_alternate_around_the_axis() -> None:
    angle = (torch.arange(10).double() + 0.2) * math.pi / 5
    points = torch.stack([torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)], -1)
    color = Checker(BLACK, WHITE, sector_planes(5)).color(points, points, points)[:, 0]
    assert color.diff().abs().eq(1).all()


@pytest.mark.parametrize("planes", [grid_planes(0.25, 3), sector_planes(4)])
def test_color_jumps_at_the_breaks_and_nowhere_else(planes) -> None:
    texture = Lit(Checker(BLACK, WHITE, planes))
    origins, directions = inside_unit_ball(50)
    breaks = texture.breaks(origins, directions).sort(dim=-1).values
    assert breaks.shape == (50, len(planes))
    t = torch.cat([breaks[:, :1] - 1, 0.5 * (breaks[:, 1:] + breaks[:, :-1]), breaks[:, -1:] + 1], -1)
    points = origins[:, None] + t[..., None] * directions[:, None]
    color = texture.color(points, 0 * points, points)[..., 0]
    assert ((color == 0) ^ (color.roll(1, -1) == 0))[:, 1:].all()


def test_lines_along_a_board_have_no_break_with_its_planes() -> None:
    origins, directions = torch.tensor([[0.1, 0.1, 0.1]]), torch.tensor([[1.0, 0.0, 0.0]])
    breaks = Checker(BLACK, WHITE, grid_planes(1.0, 1)).breaks(origins, directions)[0]
    assert breaks[torch.isfinite(breaks)].tolist() == pytest.approx([-1.1, -0.1, 0.9])


def test_highlight_is_brightest_at_the_half_vector() -> None:
    light, view = torch.tensor([0.0, 0.6, 0.8]).double(), torch.tensor([0.0, 0.6, -0.8]).double()
    gloss = Glossy(BLACK, (0.0, 0.6, 0.8), 0.9, 0.2)
    _, points = inside_unit_ball(1000)
    color = gloss.color(points, points, view.expand_as(points))[:, 0]
    half = (light - view) / (light - view).norm()
    assert torch.equal(color.argsort(), (points @ half).argsort())
    assert gloss.color(half[None], half[None], view[None])[0, 0].item() == pytest.approx(0.9)
