"""Balls that bounce on a plate: fast motion whose velocity jumps, as in D-NeRF's scene of that name."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, SLATE, TEAL
from dnerf.scenes.motions import Bounce, Fixed, Slide
from dnerf.scenes.shapes import Ball, Box, Vector
from dnerf.scenes.textures import Lit, Plain

RADIUS = 0.27
GRAVITY = 28.8
"""In world units per square of the film's length: an arc of height h takes sqrt(8 h / GRAVITY) of it."""

BALLS: tuple[tuple[Vector, float, float, int, float], ...] = (
    (TEAL, -0.55, -0.35, 2, 0.5), (CORAL, 0.50, -0.40, 2, 0.2), (AMBER, 0.00, 0.55, 3, 0.8),
)  # fmt: skip
"""Colour, x, y, bounces while t goes from 0 to 1 and share of an arc that is over at t = 0 of each ball."""

GROUND = -0.82


def make_bouncing_balls() -> AnalyticScene:
    """Three balls that bounce on a plate out of step, all under one gravity; t = 1 is t = 0 again."""
    bodies = [Body(Box((0.95, 0.95, 0.04)), Plain(SLATE), Fixed((0.0, 0.0, GROUND - 0.04)))]
    for color, x, y, bounces, phase in BALLS:
        bounce = Bounce(GRAVITY / 8 / bounces**2, bounces, phase)
        fall = Slide(bounce, parent=Fixed((x, y, GROUND + RADIUS)))
        bodies.append(Body(Ball(RADIUS), Lit(Plain(color)), fall))
    return AnalyticScene(bodies, box=((-1.0, -1.0, -0.92), (1.0, 1.0, 0.65)))
