"""A ball that is gone for a while: no deformation of a canonical scene explains it."""

from dnerf.scenes.base import AnalyticScene
from dnerf.scenes.bodies import Body
from dnerf.scenes.motions import Orbit, Spin, Vanish
from dnerf.scenes.palette import AMBER, CORAL, CREAM, PLUM
from dnerf.scenes.shapes import Ball, Box
from dnerf.scenes.textures import Gradient, Plain


def make_vanishing_ball(density: float = 80.0) -> AnalyticScene:
    """A ball circling a spinning block, not there for 0.4 <= t < 0.7; t = 1 is t = 0 again.

    Args:
        density: of both bodies, in 1 / world unit.
    """
    ball = Body(Ball(0.3), Gradient(AMBER, CORAL), Vanish((0.4, 0.7), Orbit(0.7)), density)
    block = Body(Box((0.25, 0.25, 0.4)), Plain(PLUM), Spin(), density)
    stand = Body(Box((0.45, 0.45, 0.05)), Plain(CREAM), Orbit(0.0, 1.0, 0.0, 0.0, (0.0, 0.0, -0.5)), density)
    return AnalyticScene([ball, block, stand], box=((-1.05, -1.05, -0.6), (1.05, 1.05, 0.5)))
