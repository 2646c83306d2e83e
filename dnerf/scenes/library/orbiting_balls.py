"""Coloured balls orbiting a checkered one, each at its own distance, speed and tilt."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, CREAM, INDIGO, LEAF, SKY, TEAL
from dnerf.scenes.motions import Orbit, Spin
from dnerf.scenes.shapes import Ball, Vector
from dnerf.scenes.textures import Checker, Lit, Plain, Plane, sector_planes

PLANETS: tuple[tuple[Vector, float, float, float, float, float], ...] = (
    (CORAL, 0.20, 0.72, 1.0, 0.00, 0.25), (AMBER, 0.13, 0.68, 2.0, 0.45, -0.45),
    (TEAL, 0.24, 1.00, -1.0, 0.30, -0.12), (SKY, 0.10, 1.06, 2.0, 0.85, 0.50), (LEAF, 0.15, 1.04, 1.0, 0.62, 0.16),
)  # fmt: skip
"""Colour, radius, radius of the orbit, turns, phase in turns and tilt in radians of each ball."""

BANDS: tuple[Plane, ...] = (((0.0, 0.0, 1.0), -0.15), ((0.0, 0.0, 1.0), 0.15))


def make_orbiting_balls(density: float = 80.0) -> AnalyticScene:
    """Five balls on tilted orbits around a spinning one, of one density in 1 / world unit; t = 1 is t = 0 again."""
    from_above = (0.0, 0.0, 1.0)  # the spinning ball's light must lie on its axis to stay at rest
    checkers = Checker(Plain(CREAM), Plain(INDIGO), sector_planes(5) + BANDS)
    sun = Body(Ball(0.42), Lit(checkers, from_above), Spin(), density)
    planets = [
        Body(Ball(radius), Lit(Plain(color)), Orbit(distance, turns, phase, tilt), density)
        for color, radius, distance, turns, phase, tilt in PLANETS
    ]
    return AnalyticScene([sun, *planets], box=((-1.3, -1.3, -0.75), (1.3, 1.3, 0.75)))
