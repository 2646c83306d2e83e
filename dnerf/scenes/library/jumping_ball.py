"""A ball that jumps from place to place: its motion is discontinuous in time."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, SKY, TEAL
from dnerf.scenes.motions import Jump, Spin
from dnerf.scenes.shapes import Ball, Box
from dnerf.scenes.textures import Gradient


def make_jumping_ball() -> AnalyticScene:
    """A ball in three places in turn around a spinning block; t = 1 is t = 0 again."""
    places = ((0.7, 0.0, 0.1), (-0.4, 0.6, 0.3), (-0.3, -0.7, -0.3))
    ball = Body(Ball(0.25), Gradient(AMBER, CORAL), Jump(places))
    block = Body(Box((0.2, 0.3, 0.3)), Gradient(TEAL, SKY), Spin())
    return AnalyticScene([ball, block], box=((-1.0, -1.0, -0.6), (1.0, 1.0, 0.6)))
