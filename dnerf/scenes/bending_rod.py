"""A rod that bends to and fro: a ray may enter and leave it twice."""

import math

from dnerf.scenes.base import AnalyticScene
from dnerf.scenes.bodies import Body
from dnerf.scenes.motions import Joint, Wave
from dnerf.scenes.palette import AMBER, TEAL
from dnerf.scenes.shapes import Box
from dnerf.scenes.textures import Plain, Stripes
from dnerf.scenes.warps import Bend


def make_bending_rod(amount: float = 0.7, density: float = 80.0) -> AnalyticScene:
    """A striped rod along y, bent sideways by up to `amount` times the squared distance from its middle.

    Args:
        amount: largest bend, in 1 / world unit.
        density: in 1 / world unit; bending changes no volume.
    """
    stripes = Stripes(Plain(AMBER), Plain(TEAL), (0.0, 0.0, 14.0))
    lying = Joint(axis=(1.0, 0.0, 0.0), angle=Wave(0.5 * math.pi))
    rod = Body(Box((0.12, 0.18, 0.9)), stripes, Bend(Wave(0.0, ((amount, 1.0, 0.0),)), lying), density)
    return AnalyticScene([rod], box=((-0.8, -1.0, -0.3), (0.8, 1.0, 0.3)))
