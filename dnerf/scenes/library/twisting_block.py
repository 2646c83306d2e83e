"""A tall block that twists to and fro about its axis: a smooth warp that no rigid motion explains."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import CREAM, INDIGO
from dnerf.scenes.motions import Wave
from dnerf.scenes.shapes import Box
from dnerf.scenes.textures import Plain, Stripes
from dnerf.scenes.warps import Twist


def make_twisting_block() -> AnalyticScene:
    """A striped block, twisted by up to 1.5 radians per unit of height; t = 1 is t = 0 again."""
    stripes = Stripes(Plain(CREAM), Plain(INDIGO), (12.0, 0.0, 8.0))
    block = Body(Box((0.4, 0.25, 0.8)), stripes, Twist(Wave(0.0, ((1.5, 1.0, 0.0),))))
    return AnalyticScene([block], box=((-0.6, -0.6, -0.9), (0.6, 0.6, 0.9)))
