"""A long bank of dense fog with a ball moving in it: many samples, each nearly clear, together opaque."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import CORAL, CREAM, SKY
from dnerf.scenes.motions import Orbit
from dnerf.scenes.shapes import Ball, Box
from dnerf.scenes.textures import Glow, Gradient


def make_dense_fog() -> AnalyticScene:
    """Fog 2.2 units long (optical depth 15) and a ball that comes to its surface and sinks; t = 1 is t = 0 again."""
    fog = Body(Box((1.1, 0.8, 0.7)), Glow(SKY, CREAM, 1.6), density=7.0)
    ball = Body(Ball(0.25), Gradient(CREAM, CORAL), Orbit(0.5, 1.0, 0.0, 0.3))
    return AnalyticScene([fog, ball], box=((-1.2, -0.9, -0.8), (1.2, 0.9, 0.8)))
