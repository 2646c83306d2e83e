"""A rod that bends to and fro: a ray may enter and leave it twice."""

import math

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, TEAL
from dnerf.scenes.motions import Joint, Wave
from dnerf.scenes.shapes import Box
from dnerf.scenes.textures import Plain, Stripes
from dnerf.scenes.warps import Bend


def make_bending_rod() -> AnalyticScene:
    """A striped rod along y, bent sideways by up to 0.7 times the squared distance from its middle."""
    stripes = Stripes(Plain(AMBER), Plain(TEAL), (0.0, 0.0, 14.0))
    lying = Joint(axis=(1.0, 0.0, 0.0), angle=Wave(0.5 * math.pi))
    rod = Body(Box((0.12, 0.18, 0.9)), stripes, Bend(Wave(0.0, ((0.7, 1.0, 0.0),)), parent=lying))
    return AnalyticScene([rod], box=((-0.8, -1.0, -0.3), (0.8, 1.0, 0.3)))
