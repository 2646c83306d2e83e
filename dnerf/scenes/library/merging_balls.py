"""Two balls that move into each other until they are one, and part again: their topology changes."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, INDIGO, SKY
from dnerf.scenes.motions import Slide, Wave
from dnerf.scenes.shapes import Ball
from dnerf.scenes.textures import Gradient


def make_merging_balls() -> AnalyticScene:
    """Two equal balls on the x axis that meet in the origin at t = 1/2; densities add up; t = 1 is t = 0 again."""
    apart = Wave(0.3, ((0.3, 1.0, 0.25),))  # a cosine: 0.6 at t = 0 and 1, 0 at t = 1/2
    balls = [
        Body(Ball(0.4), Gradient(low, high), Slide(apart, (side, 0.0, 0.0)), density=40.0)
        for side, low, high in ((1.0, AMBER, CORAL), (-1.0, INDIGO, SKY))
    ]
    return AnalyticScene(balls, box=((-1.1, -0.5, -0.5), (1.1, 0.5, 0.5)))
