"""Animated analytic scenes: radiance fields without parameters whose pictures and motions are known exactly."""

from collections.abc import Callable

from dnerf.checks import check_choice
from dnerf.scenes.base import AnalyticScene
from dnerf.scenes.bodies import Body
from dnerf.scenes.exact_motion import ExactFlow, ExactTracks, exact_flow, exact_tracks, first_surfaces, is_visible
from dnerf.scenes.glossy_ball import make_glossy_ball
from dnerf.scenes.motions import Fixed, Joint, Motion, Orbit, Pulse, Slide, Spin, Wave
from dnerf.scenes.orbiting_balls import make_orbiting_balls
from dnerf.scenes.poses import Pose
from dnerf.scenes.pulsing_fog import make_pulsing_fog
from dnerf.scenes.shapes import Ball, Box, Capsule, Shape
from dnerf.scenes.static import make_static
from dnerf.scenes.textures import (
    Checker,
    Glossy,
    Glow,
    Gradient,
    Lit,
    Plain,
    Shadowed,
    Stripes,
    Texture,
    grid_planes,
    sector_planes,
)
from dnerf.scenes.walker import make_walker

SCENES: dict[str, Callable[[], AnalyticScene]] = {
    "glossy_ball": make_glossy_ball,
    "orbiting_balls": make_orbiting_balls,
    "pulsing_fog": make_pulsing_fog,
    "static": make_static,
    "walker": make_walker,
}
"""Scenes by name, each built with its defaults."""


def make_scene(name: str) -> AnalyticScene:
    """Return the scene of the given name.

    Raises:
        ValueError: for a name not in `SCENES`.
    """
    check_choice("scene", name, sorted(SCENES))
    return SCENES[name]()


__all__ = [
    "SCENES",
    "AnalyticScene",
    "Ball",
    "Body",
    "Box",
    "Capsule",
    "Checker",
    "ExactFlow",
    "ExactTracks",
    "Fixed",
    "Glossy",
    "Glow",
    "Gradient",
    "Joint",
    "Lit",
    "Motion",
    "Orbit",
    "Plain",
    "Pose",
    "Pulse",
    "Shadowed",
    "Shape",
    "Slide",
    "Spin",
    "Stripes",
    "Texture",
    "Wave",
    "exact_flow",
    "exact_tracks",
    "first_surfaces",
    "grid_planes",
    "is_visible",
    "make_glossy_ball",
    "make_orbiting_balls",
    "make_pulsing_fog",
    "make_scene",
    "make_static",
    "make_walker",
    "sector_planes",
]
