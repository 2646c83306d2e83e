"""Nothing moves: a ball, a box and a capsule stand on a chessboard."""

import math

from dnerf.scenes.base import AnalyticScene
from dnerf.scenes.bodies import Body
from dnerf.scenes.motions import Fixed
from dnerf.scenes.palette import AMBER, CORAL, CREAM, SLATE, TEAL
from dnerf.scenes.shapes import Ball, Box, Capsule
from dnerf.scenes.textures import Checker, Lit, Plain, Shadowed, grid_planes


def make_static(density: float = 80.0) -> AnalyticScene:
    """A ball, a box and a capsule on a chessboard, the same at all times.

    Args:
        density: of all bodies, in 1 / world unit.
    """
    floor = -0.5
    board = Checker(Plain(CREAM), Plain(SLATE), grid_planes(0.25, 3, "xy"))
    shadows = ((0.38, -0.32, 0.36), (-0.42, -0.28, 0.42), (0.02, 0.48, 0.30))
    bodies = [
        Body(Box((1.0, 1.0, 0.04)), Shadowed(Lit(board), shadows), Fixed((0.0, 0.0, floor - 0.04)), density),
        Body(Ball(0.36), Lit(Plain(CORAL)), Fixed((0.38, -0.32, floor + 0.36)), density),
        Body(
            Box((0.28, 0.28, 0.28)),
            Lit(Plain(TEAL)),
            Fixed((-0.42, -0.28, floor + 0.28), (0.0, 0.0, math.radians(28))),
            density,
        ),
        Body(Capsule(0.2, (0.0, 0.0, 0.55)), Lit(Plain(AMBER)), Fixed((0.02, 0.48, floor + 0.2)), density),
    ]
    return AnalyticScene(bodies, box=((-1.05, -1.05, -0.6), (1.05, 1.05, 0.5)))
