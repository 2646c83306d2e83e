"""A small ball so fast that it crosses its own diameter between two of a hundred frames."""

from dnerf.scenes.base import AnalyticScene
from dnerf.scenes.bodies import Body
from dnerf.scenes.motions import Fixed, Orbit
from dnerf.scenes.palette import AMBER, CORAL, INDIGO, SKY
from dnerf.scenes.shapes import Ball, Box
from dnerf.scenes.textures import Gradient


def make_fast_ball(radius: float = 0.06, turns: int = 2, density: float = 80.0) -> AnalyticScene:
    """A ball on a tilted circle of radius 0.96 about a still block; t = 1 is t = 0 again.

    Args:
        radius: of the ball; at two turns it moves 0.12 world units in a hundredth of the time.
        turns: while t goes from 0 to 1.
        density: of both bodies, in 1 / world unit.
    """
    ball = Body(Ball(radius), Gradient(AMBER, CORAL), Orbit(0.96, turns, 0.0, 0.4), density)
    block = Body(Box((0.35, 0.35, 0.5)), Gradient(INDIGO, SKY), Fixed(), density)
    return AnalyticScene([ball, block], box=((-1.1, -1.1, -0.6), (1.1, 1.1, 0.6)))
