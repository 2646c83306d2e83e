"""A tall block that twists to and fro about its axis: a smooth warp that no rigid motion explains."""

from dnerf.scenes.base import AnalyticScene
from dnerf.scenes.bodies import Body
from dnerf.scenes.motions import Wave
from dnerf.scenes.palette import CREAM, INDIGO
from dnerf.scenes.shapes import Box
from dnerf.scenes.textures import Plain, Stripes
from dnerf.scenes.warps import Twist


def make_twisting_block(amount: float = 1.5, density: float = 80.0) -> AnalyticScene:
    """A striped block, twisted by up to `amount` radians per unit of height; t = 1 is t = 0 again.

    Args:
        amount: largest twist.
        density: in 1 / world unit; twisting changes no volume.
    """
    stripes = Stripes(Plain(CREAM), Plain(INDIGO), (12.0, 0.0, 8.0))
    block = Body(Box((0.4, 0.25, 0.8)), stripes, Twist(Wave(0.0, ((amount, 1.0, 0.0),))), density)
    return AnalyticScene([block], box=((-0.6, -0.6, -0.9), (0.6, 0.6, 0.9)))
