"""Nothing moves: a ball, a box and a capsule stand on a chessboard."""

import math

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, CREAM, SLATE, TEAL
from dnerf.scenes.motions import Fixed, Joint, Wave
from dnerf.scenes.shapes import Ball, Box, Capsule
from dnerf.scenes.textures import Checker, Lit, Plain, Shadowed, grid_planes


def make_static(density: float = 80.0) -> AnalyticScene:
    """A ball, a box and a capsule on a chessboard, of one density in 1 / world unit, the same at all times."""
    floor = -0.42
    board = Checker(Plain(CREAM), Plain(SLATE), grid_planes(0.21, 3, "xy"))
    shadows = ((0.32, -0.27, 0.30), (-0.35, -0.24, 0.35), (0.02, 0.40, 0.25))
    turned = Joint((-0.35, -0.24, floor + 0.24), angle=Wave(math.radians(28)))
    bodies = [
        Body(Box((0.84, 0.84, 0.035)), Shadowed(Lit(board), shadows), Fixed((0.0, 0.0, floor - 0.035)), density),
        Body(Ball(0.3), Lit(Plain(CORAL)), Fixed((0.32, -0.27, floor + 0.3)), density),
        Body(Box((0.24, 0.24, 0.24)), Lit(Plain(TEAL)), turned, density),
        Body(Capsule(0.17, (0.0, 0.0, 0.46)), Lit(Plain(AMBER)), Fixed((0.02, 0.40, floor + 0.17)), density),
    ]
    return AnalyticScene(bodies, box=((-0.9, -0.9, -0.5), (0.9, 0.9, 0.42)))
