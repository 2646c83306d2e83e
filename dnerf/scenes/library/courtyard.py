"""A courtyard filmed from within: ground, pillars and walls without two like places, and two things that move."""

import math
from random import Random

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, CREAM, INDIGO, LEAF, PLUM, SKY, SLATE, TEAL
from dnerf.scenes.motions import Fixed, Joint, Orbit, Slide, Spin, Wave
from dnerf.scenes.shapes import Ball, Box, Capsule, Shape, Vector
from dnerf.scenes.textures import Checker, Lit, Plain, Plane, sector_planes

GROUND = -0.16  # its height: a camera at the origin's height is some 1.3 metres up, if a unit is 8 metres
THIN = 0.02  # half the thickness of walls and of the ground
DENSITY = 4000.0  # in 1 / world unit: light is gone within a pixel's width of the surface
SUN = (-0.4, -0.5, 0.77)
STONES = ((0.72, 0.68, 0.6), SLATE, (0.5, 0.46, 0.42), CREAM)
PAINTS = ((CREAM, INDIGO, AMBER, SLATE), (SKY, PLUM, CREAM, TEAL), (CORAL, CREAM, SLATE, LEAF))
WALLS = ((0.0, 1.18, 0.32), (-1.18, 0.0, 0.24), (1.18, 0.0, 0.2))
"""Their middles, x and y, and half their heights."""

PILLARS: tuple[tuple[float, float], ...] = ((-0.42, 0.38), (0.1, 0.62), (0.5, 0.3), (-0.7, 0.85), (0.75, 0.95))
"""Where they stand, x and y."""


def make_courtyard() -> AnalyticScene:
    """A beach ball that goes round a turning, nodding post in the middle of a courtyard; t = 1 is t = 0 again.

    The walls are three to four times as far away as the middle is from a camera at 0.35 from it. One side, -y, is open.
    """
    bodies = [_still(Box((1.2, 1.2, THIN)), (0.0, 0.0, GROUND - THIN), STONES, 28)]
    for (x, y, half), paints in zip(WALLS, PAINTS):
        size = (THIN if x else 1.14, THIN if y else 1.14, half)
        bodies.append(_still(Box(size), (x, y, GROUND + half), paints, 8))
    for (x, y), paints in zip(PILLARS, PAINTS + PAINTS):
        bodies.append(_still(Capsule(0.05, (0.0, 0.0, 0.36)), (x, y, GROUND + 0.05), paints, 4))
    post = Spin(parent=Joint((0.0, 0.0, GROUND), (0.0, 1.0, 0.0), Wave(0.0, ((0.3, 2.0, 0.0),))))
    bands = Checker(Plain(CORAL), Plain(CREAM), tuple(((0.0, 0.3, 0.954), 0.035 * k) for k in range(6)))
    sectors = Checker(Plain(AMBER), Plain(TEAL), (*sector_planes(3), ((0.0, 0.0, 1.0), 0.0)))
    roll = Orbit(0.1, parent=Slide(Wave(0.02, ((0.02, 3.0, 0.75),)), parent=Fixed((0.0, 0.0, GROUND + 0.046))))
    bodies.append(Body(Capsule(0.025, (0.0, 0.0, 0.16)), bands, Fixed((0.0, 0.0, 0.028), parent=post), DENSITY))
    bodies.append(Body(Ball(0.045), Lit(sectors, SUN), roll, DENSITY))
    return AnalyticScene(bodies, box=((-1.25, -1.25, -0.25), (1.25, 1.25, 0.55)))


def _still(shape: Shape, place: Vector, paints: tuple[Vector, ...], count: int) -> Body:
    """A body at rest in four colours, between three times so many random planes, upright on a wall or the ground."""
    random = Random(f"{place}")  # the same at every start
    low, high = shape.bounds
    groups: list[tuple[Plane, ...]] = []
    for _ in range(3):
        planes = []
        for _ in range(count):
            direction = [0.0 if b == THIN else random.gauss(0, 1) for b in high]
            x, y, z = (value / math.hypot(*direction) for value in direction)
            planes.append(((x, y, z), sum(n * random.uniform(*ends) for n, *ends in zip((x, y, z), low, high))))
        groups.append(tuple(planes))
    a, b, c, d = map(Plain, paints)
    pattern = Checker(Checker(a, b, groups[0]), Checker(c, d, groups[1]), groups[2])
    return Body(shape, Lit(pattern, SUN), Fixed(place), DENSITY)
