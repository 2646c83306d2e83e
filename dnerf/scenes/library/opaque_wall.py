"""A wall so dense that the first sample inside stops all light, close in front of cameras on one side."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import CORAL, CREAM, SLATE, TEAL
from dnerf.scenes.motions import Fixed, Slide, Wave
from dnerf.scenes.shapes import Ball, Box
from dnerf.scenes.textures import Gradient, Lit, Plain


def make_opaque_wall() -> AnalyticScene:
    """A wall across the x axis; behind it a ball of ordinary density goes up and down; t = 1 is t = 0 again."""
    wall = Body(Box((0.04, 1.0, 0.9)), Plain(SLATE), Fixed((0.9, 0.0, 0.0)), density=1e5)
    up_and_down = Slide(Wave(0.0, ((0.3, 1.0, 0.0),)), parent=Fixed((-0.2, 0.0, 0.0)))
    ball = Body(Ball(0.45), Lit(Gradient(TEAL, CORAL)), up_and_down)
    post = Body(Box((0.05, 0.05, 0.85)), Plain(CREAM), Fixed((-0.95, 0.6, 0.0)))
    return AnalyticScene([wall, ball, post], box=((-1.05, -1.05, -0.95), (1.0, 1.05, 0.95)))
