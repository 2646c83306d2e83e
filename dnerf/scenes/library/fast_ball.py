"""A small ball so fast that it crosses its own diameter between two of a hundred frames."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, INDIGO, SKY
from dnerf.scenes.motions import Orbit
from dnerf.scenes.shapes import Ball, Box
from dnerf.scenes.textures import Gradient


def make_fast_ball() -> AnalyticScene:
    """A ball that runs twice about a still block, 0.12 units in a hundredth of the time; t = 1 is t = 0 again."""
    ball = Body(Ball(0.06), Gradient(AMBER, CORAL), Orbit(0.96, turns=2.0, tilt=0.4))
    block = Body(Box((0.35, 0.35, 0.5)), Gradient(INDIGO, SKY))
    return AnalyticScene([ball, block], box=((-1.1, -1.1, -0.6), (1.1, 1.1, 0.6)))
