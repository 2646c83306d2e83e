"""A snowman and coal: colours next to white and next to black, faint patterns on both, white before white."""

import math

from dnerf.scenes.base import AnalyticScene
from dnerf.scenes.bodies import Body
from dnerf.scenes.motions import Fixed, Joint, Wave
from dnerf.scenes.shapes import Ball, Box
from dnerf.scenes.textures import Checker, Gradient, Lit, Plain, Stripes, grid_planes

PURE = Plain((1.0, 1.0, 1.0))
SNOW = Stripes(Gradient((0.84, 0.88, 0.94), (0.97, 0.98, 1.0)), PURE, (0.0, 0.0, 2 * math.pi / 0.24))
"""Bands of pure white, and of white that is a little bluer below."""

COAL = Lit(Checker(Plain((0.02, 0.02, 0.03)), Plain((0.09, 0.08, 0.08)), grid_planes(0.11, 2)))
"""Two blacks that lie as close together as the colours of a dark picture."""

GROUND = -0.8


def make_snowman(density: float = 80.0) -> AnalyticScene:
    """A snowman that bows and nods on a black board, and two lumps of coal that slide around it; t = 1 is t = 0 again.

    Balls touch in one point at their joints: where bodies overlap, colours mix.

    Args:
        density: of all bodies, in 1 / world unit.
    """
    bow = Joint(None, (0.0, 0.0, GROUND + 0.68), (0.0, 1.0, 0.0), Wave(0.0, ((0.35, 1.0, 0.0),)))
    nod = Joint(bow, (0.0, 0.0, 0.52), (1.0, 0.0, 0.0), Wave(0.0, ((0.3, 2.0, 0.1),)))
    board = Lit(Checker(Plain((0.03, 0.03, 0.04)), Plain((0.12, 0.11, 0.12)), grid_planes(0.2, 4, "xy")))
    button = Plain((0.02, 0.02, 0.02))
    bodies = [
        Body(Box((0.9, 0.9, 0.03)), board, Fixed((0.0, 0.0, GROUND - 0.03)), density),
        Body(Ball(0.34), SNOW, Fixed((0.0, 0.0, GROUND + 0.34)), density),
        Body(Ball(0.26), SNOW, Joint(bow, (0.0, 0.0, 0.26)), density),
        Body(Ball(0.2), SNOW, Joint(nod, (0.0, 0.0, 0.2)), density),
        Body(Box((0.13, 0.13, 0.12)), COAL, Joint(nod, (0.0, 0.0, 0.5)), density),
        Body(Ball(0.035), button, Joint(nod, (0.18, 0.07, 0.25)), density),
        Body(Ball(0.035), button, Joint(nod, (0.18, -0.07, 0.25)), density),
        Body(Ball(0.04), button, Joint(bow, (0.25, 0.0, 0.31)), density),
    ]
    for phase, angle in ((0.0, 0.0), (0.3, math.pi)):
        around = Joint(None, (0.0, 0.0, GROUND + 0.14), (0.0, 0.0, 1.0), Wave(angle, ((0.7, 1.0, phase),)))
        lump = Joint(around, (0.62, 0.0, 0.0), (0.0, 0.0, 1.0), Wave(0.4, ((0.6, 1.0, phase),)))
        bodies.append(Body(Box((0.14, 0.14, 0.14)), COAL, lump, density))
    return AnalyticScene(bodies, box=((-0.95, -0.95, -0.9), (0.95, 0.95, 1.1)))
