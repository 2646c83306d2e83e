"""A spinning rod two thousandths thick, held by a small hub: what samples miss unless they know where matter is."""

from dnerf.scenes.base import AnalyticScene
from dnerf.scenes.bodies import Body
from dnerf.scenes.motions import Fixed, Joint, Spin
from dnerf.scenes.palette import CORAL, INDIGO
from dnerf.scenes.shapes import Ball, Capsule
from dnerf.scenes.textures import Gradient, Plain


def make_thin_rod(radius: float = 1e-3, density: float = 4000.0) -> AnalyticScene:
    """A rod that turns once about a tilted axis; t = 1 is t = 0 again.

    Args:
        radius: of the rod, in world units.
        density: of the rod, in 1 / world unit; the hub's is 80.
    """
    tilted = Fixed(rotation_vector=(0.5, 0.0, 0.0))
    turning = Spin(tilted)
    rod = Body(Capsule(radius, (1.8, 0.0, 0.0)), Plain(CORAL), Joint(turning, (-0.9, 0.0, 0.0)), density)
    hub = Body(Ball(0.3), Gradient(INDIGO, CORAL), turning)
    return AnalyticScene([rod, hub], box=((-1.0, -1.0, -0.6), (1.0, 1.0, 0.6)))
