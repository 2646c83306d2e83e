"""A spinning rod two thousandths thick, held by a small hub: what samples miss unless they know where it is."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import CORAL, INDIGO
from dnerf.scenes.motions import Fixed, Joint, Spin, Wave
from dnerf.scenes.shapes import Ball, Capsule
from dnerf.scenes.textures import Gradient, Plain


def make_thin_rod() -> AnalyticScene:
    """A rod that turns once about a tilted axis; t = 1 is t = 0 again."""
    turning = Spin(parent=Joint(axis=(1.0, 0.0, 0.0), angle=Wave(0.5)))
    rod = Body(Capsule(1e-3, (1.8, 0.0, 0.0)), Plain(CORAL), Fixed((-0.9, 0.0, 0.0), parent=turning), density=4000.0)
    hub = Body(Ball(0.3), Gradient(INDIGO, CORAL), turning)
    return AnalyticScene([rod, hub], box=((-1.0, -1.0, -0.6), (1.0, 1.0, 0.6)))
