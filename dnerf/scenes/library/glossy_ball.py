"""A glossy ball whose highlight moves with the eye: colour that no function of position alone explains."""

from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, CREAM, PLUM, SKY, TEAL
from dnerf.scenes.motions import Orbit, Slide, Wave
from dnerf.scenes.shapes import Ball
from dnerf.scenes.textures import Glossy, Gradient, Lit, Plain

BEADS = (AMBER, TEAL, CREAM, SKY)
"""Colours of the small balls."""


def make_glossy_ball() -> AnalyticScene:
    """A large glossy ball that slowly rises and sinks, ringed by small glossy balls; t = 1 is t = 0 again."""
    # No body turns, so all highlights belong to one light at rest.
    bob = Slide(Wave(0.0, ((0.14, 1.0, 0.0),)))
    bodies = [Body(Ball(0.62), Glossy(Lit(Gradient(PLUM, CORAL))), bob)]
    for index, color in enumerate(BEADS):
        orbit = Orbit(0.98, phase=index / len(BEADS), tilt=0.2)
        bodies.append(Body(Ball(0.13), Glossy(Lit(Plain(color)), width=0.3), orbit))
    return AnalyticScene(bodies, box=((-1.2, -1.2, -0.85), (1.2, 1.2, 0.85)))
