"""A ball that is gone for a while: no deformation of a canonical scene explains it."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, CREAM, PLUM
from dnerf.scenes.motions import Fixed, Orbit, Spin, Vanish
from dnerf.scenes.shapes import Ball, Box
from dnerf.scenes.textures import Gradient, Plain


def make_vanishing_ball() -> AnalyticScene:
    """A ball circling a spinning block, not there for 0.4 <= t < 0.7; t = 1 is t = 0 again."""
    ball = Body(Ball(0.3), Gradient(AMBER, CORAL), Vanish((0.4, 0.7), parent=Orbit(0.7)))
    block = Body(Box((0.25, 0.25, 0.4)), Plain(PLUM), Spin())
    stand = Body(Box((0.45, 0.45, 0.05)), Plain(CREAM), Fixed((0.0, 0.0, -0.5)))
    return AnalyticScene([ball, block, stand], box=((-1.05, -1.05, -0.6), (1.05, 1.05, 0.5)))
