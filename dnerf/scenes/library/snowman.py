"""A snowman and coal: colours next to white and next to black, faint patterns on both, white before white."""

import math

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.motions import Fixed, Joint, Wave
from dnerf.scenes.shapes import Ball, Box
from dnerf.scenes.textures import Checker, Gradient, Lit, Plain, Stripes, grid_planes

PURE = Plain((1.0, 1.0, 1.0))
SNOW = Stripes(Gradient((0.84, 0.88, 0.94), (0.97, 0.98, 1.0)), PURE, (0.0, 0.0, 2 * math.pi / 0.24))
"""Bands of pure white, and of white that is a little bluer below."""

COAL = Lit(Checker(Plain((0.02, 0.02, 0.03)), Plain((0.09, 0.08, 0.08)), grid_planes(0.11, 2)))
"""Two blacks that lie as close together as the colours of a dark image."""

GROUND = -0.8


def make_snowman() -> AnalyticScene:
    """A snowman that bows and nods on a black board, and two lumps of coal that slide around it; t = 1 is t = 0 again.

    Balls touch in one point at their joints: where bodies overlap, colours mix.
    """
    bow = Joint((0.0, 0.0, GROUND + 0.68), (0.0, 1.0, 0.0), Wave(0.0, ((0.35, 1.0, 0.0),)))
    nod = Joint((0.0, 0.0, 0.52), (1.0, 0.0, 0.0), Wave(0.0, ((0.3, 2.0, 0.1),)), parent=bow)
    board = Lit(Checker(Plain((0.03, 0.03, 0.04)), Plain((0.12, 0.11, 0.12)), grid_planes(0.2, 4, "xy")))
    button = Plain((0.02, 0.02, 0.02))
    bodies = [
        Body(Box((0.9, 0.9, 0.03)), board, Fixed((0.0, 0.0, GROUND - 0.03))),
        Body(Ball(0.34), SNOW, Fixed((0.0, 0.0, GROUND + 0.34))),
        Body(Ball(0.26), SNOW, Fixed((0.0, 0.0, 0.26), parent=bow)),
        Body(Ball(0.2), SNOW, Fixed((0.0, 0.0, 0.2), parent=nod)),
        Body(Box((0.13, 0.13, 0.12)), COAL, Fixed((0.0, 0.0, 0.5), parent=nod)),
        Body(Ball(0.035), button, Fixed((0.18, 0.07, 0.25), parent=nod)),
        Body(Ball(0.035), button, Fixed((0.18, -0.07, 0.25), parent=nod)),
        Body(Ball(0.04), button, Fixed((0.25, 0.0, 0.31), parent=bow)),
    ]
    for phase, angle in ((0.0, 0.0), (0.3, math.pi)):
        around = Joint((0.0, 0.0, GROUND + 0.14), angle=Wave(angle, ((0.7, 1.0, phase),)))
        lump = Joint((0.62, 0.0, 0.0), angle=Wave(0.4, ((0.6, 1.0, phase),)), parent=around)
        bodies.append(Body(Box((0.14, 0.14, 0.14)), COAL, lump))
    return AnalyticScene(bodies, box=((-0.95, -0.95, -0.9), (0.95, 0.95, 1.1)))
