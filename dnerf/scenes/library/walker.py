"""A figure of capsules that walks: joints that carry joints, as in skinned characters."""

import math
from dataclasses import dataclass

from dnerf.core.checks import check_positive, check_within
from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.library.palette import AMBER, CORAL, CREAM, INDIGO, SKIN, SLATE, TEAL
from dnerf.scenes.motions import Fixed, Joint, Motion, Slide, Spin, Wave
from dnerf.scenes.shapes import Ball, Box, Capsule, Shape
from dnerf.scenes.textures import Checker, Lit, Plain, Shadowed, Stripes, Texture, grid_planes

LIGHT = (0.48, 0.36, 0.8)
GROUND = -0.86
FORWARD = (0.0, -1.0, 0.0)
"""Axis about which a hanging limb swings forwards, along x; the figure's left is y."""

SHIRT = Stripes(Plain(CORAL), Plain(CREAM), (0.0, 0.0, 2 * math.pi / 0.16))
TROUSERS = Plain(INDIGO)
Part = tuple[Shape, Texture, Motion]


@dataclass(frozen=True)
class Gait:
    """Angles of one side's joints: double steps while t goes from 0 to 1, and the side's phase in turns."""

    cycles: float
    phase: float

    def swing(self, mean: float, amplitude: float, lead: float = 0.0) -> Wave:
        """A limb that swings forwards and back, angles in radians."""
        return Wave(mean, ((amplitude, self.cycles, self.phase + lead),))

    def lift(self, rest: float, amplitude: float, lead: float) -> Wave:
        """A joint that bends once per cycle and is nearly straight in between: rest + a ((1 + cos) / 2)^2."""
        turn = self.phase + lead
        first = (0.5 * amplitude, self.cycles, turn + 0.25)
        second = (0.125 * amplitude, 2 * self.cycles, 2 * turn + 0.25)
        return Wave(rest + 0.375 * amplitude, (first, second))


def make_walker(cycles: int = 1, circle_radius: float = 0.0, density: float = 80.0) -> AnalyticScene:
    """A striped figure walking on a chessboard, on the spot or once around a circle; t = 1 is t = 0 again.

    Args:
        cycles: double steps while t goes from 0 to 1.
        circle_radius: of the circle it walks, in [0, 0.35] world units; 0 walks on the spot.
        density: of all bodies, in 1 / world unit.

    Raises:
        ValueError: if the circle leaves the board.
    """
    check_positive("cycles", cycles)
    check_within("circle_radius", circle_radius, "[0, 0.35]")
    path = Fixed((0.0, -circle_radius, GROUND + 0.76), parent=Spin() if circle_radius > 0 else None)
    hips = Slide(Wave(-0.025, ((0.025, 2.0 * cycles, 0.25),)), parent=path)
    twist = Joint(angle=Wave(0.0, ((0.12, cycles, 0.5),)), parent=hips)
    lean = Joint(axis=FORWARD, angle=Wave(-0.06), parent=twist)
    parts = _trunk(hips, lean)
    for side, phase in ((1.0, 0.0), (-1.0, 0.5)):
        parts += _leg(hips, side, Gait(cycles, phase)) + _arm(lean, side, Gait(cycles, phase + 0.5))
    bodies = [Body(shape, Lit(texture, LIGHT), motion, density) for shape, texture, motion in parts]
    board = Checker(Plain(CREAM), Plain(TEAL), grid_planes(0.175, 3, "xy"))
    shadow = Shadowed(Lit(board), ((0.0, 0.0, 0.3 + circle_radius),), strength=0.45)
    bodies.append(Body(Box((0.7, 0.7, 0.03)), shadow, Fixed((0.0, 0.0, GROUND - 0.03)), density))
    return AnalyticScene(bodies, box=((-0.9, -0.9, -0.95), (0.9, 0.9, 0.9)))


def _trunk(hips: Motion, lean: Motion) -> list[Part]:
    """Pelvis, chest and head, with eyes that look where it goes."""
    nod = Fixed((0.02, 0.0, 0.69), parent=lean)
    hair = Checker(Plain(SKIN), Plain(SLATE), (((-0.5, 0.0, 0.866), 0.05),))
    return [
        (Capsule(0.125, (0.0, 0.12, 0.0)), TROUSERS, Fixed((0.0, -0.06, 0.02), parent=hips)),
        (Capsule(0.165, (0.0, 0.0, 0.27)), SHIRT, Fixed((0.0, 0.0, 0.13), parent=lean)),
        (Ball(0.18), hair, nod),
        (Ball(0.03), Plain(SLATE), Fixed((0.148, 0.062, 0.025), parent=nod)),
        (Ball(0.03), Plain(SLATE), Fixed((0.148, -0.062, 0.025), parent=nod)),
    ]


def _leg(hips: Motion, side: float, gait: Gait) -> list[Part]:
    """Thigh, shin and foot."""
    hip = Joint((0.0, 0.1 * side, 0.0), FORWARD, gait.swing(0.05, 0.5), parent=hips)
    knee = Joint((0.0, 0.0, -0.34), (0.0, 1.0, 0.0), gait.lift(0.08, 0.8, 0.06), parent=hip)
    ankle = Joint((0.0, 0.0, -0.33), FORWARD, gait.swing(-0.03, 0.2, -0.2), parent=knee)
    return [
        (Capsule(0.092, (0.0, 0.0, -0.34)), TROUSERS, hip),
        (Capsule(0.07, (0.0, 0.0, -0.32)), TROUSERS, knee),
        (Capsule(0.066, (0.12, 0.0, 0.0)), Plain(AMBER), Fixed((0.0, 0.0, -0.02), parent=ankle)),
    ]


def _arm(chest: Motion, side: float, gait: Gait) -> list[Part]:
    """Upper arm, forearm and hand."""
    outwards = Joint((0.0, 0.2 * side, 0.42), (1.0, 0.0, 0.0), Wave(0.16 * side), parent=chest)
    shoulder = Joint(axis=FORWARD, angle=gait.swing(0.0, 0.6), parent=outwards)
    elbow = Joint((0.0, 0.0, -0.25), FORWARD, gait.swing(0.6, 0.35, -0.05), parent=shoulder)
    return [
        (Capsule(0.072, (0.0, 0.0, -0.25)), SHIRT, shoulder),
        (Capsule(0.056, (0.0, 0.0, -0.22)), Plain(SKIN), elbow),
        (Ball(0.07), Plain(SKIN), Fixed((0.0, 0.0, -0.25), parent=elbow)),
    ]
