"""Clouds of coloured fog that breathe: semi-transparent at all times, thinner as they grow."""

from dnerf.core.checks import check_within
from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, CREAM, INDIGO, PLUM, SKY, TEAL
from dnerf.scenes.motions import Fixed, Pulse, Wave
from dnerf.scenes.shapes import Ball, Vector
from dnerf.scenes.textures import Glow

CLOUDS: tuple[tuple[Vector, Vector, Vector, float, float, float], ...] = (
    (AMBER, CORAL, (0.0, 0.0, 0.0), 0.62, 2.2, 0.0), (SKY, INDIGO, (0.48, 0.42, 0.1), 0.40, 3.0, 0.5),
    (CREAM, TEAL, (-0.50, 0.10, -0.22), 0.38, 3.0, 0.25), (CORAL, PLUM, (0.05, -0.52, 0.18), 0.34, 3.4, 0.75),
)  # fmt: skip
"""Core and rim colour, centre, radius, density and phase of the breath in turns of each cloud."""


def make_pulsing_fog(amplitude: float = 0.25) -> AnalyticScene:
    """Four overlapping clouds whose mass is conserved; t = 1 is t = 0 again.

    Args:
        amplitude: relative change of the radii, in [0, 0.3].

    Raises:
        ValueError: for an amplitude outside its range, with which clouds would leave the box.
    """
    check_within("amplitude", amplitude, "[0, 0.3]")
    clouds = []
    for core, rim, center, radius, density, phase in CLOUDS:
        breath = Pulse(Wave(1.0, ((amplitude, 1.0, phase),)), parent=Fixed(center))
        clouds.append(Body(Ball(radius), Glow(core, rim, radius), breath, density, conserves_mass=True))
    return AnalyticScene(clouds, box=((-1.15, -1.15, -0.95), (1.15, 1.15, 0.95)))
