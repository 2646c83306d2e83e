"""Animated analytic scenes: radiance fields without parameters whose pictures and motions are known exactly."""

from collections.abc import Callable

from dnerf.checks import check_choice
from dnerf.scenes.base import AnalyticScene
from dnerf.scenes.bending_rod import make_bending_rod
from dnerf.scenes.bodies import Body
from dnerf.scenes.bouncing_balls import make_bouncing_balls
from dnerf.scenes.dense_fog import make_dense_fog
from dnerf.scenes.exact_motion import ExactFlow, ExactTracks, exact_flow, exact_tracks, first_surfaces, is_visible
from dnerf.scenes.fast_ball import make_fast_ball
from dnerf.scenes.glossy_ball import make_glossy_ball
from dnerf.scenes.jumping_ball import make_jumping_ball
from dnerf.scenes.merging_balls import make_merging_balls
from dnerf.scenes.motions import Bounce, Fixed, Joint, Jump, Motion, Orbit, Pulse, Slide, Spin, Vanish, Wave
from dnerf.scenes.opaque_wall import make_opaque_wall
from dnerf.scenes.orbiting_balls import make_orbiting_balls
from dnerf.scenes.poses import Pose
from dnerf.scenes.pulsing_fog import make_pulsing_fog
from dnerf.scenes.shapes import Ball, Box, Capsule, Shape
from dnerf.scenes.snowman import make_snowman
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
from dnerf.scenes.thin_rod import make_thin_rod
from dnerf.scenes.twisting_block import make_twisting_block
from dnerf.scenes.vanishing_ball import make_vanishing_ball
from dnerf.scenes.walker import make_walker
from dnerf.scenes.warps import Bend, Twist, Warp

SCENES: dict[str, Callable[[], AnalyticScene]] = {
    "bending_rod": make_bending_rod,
    "bouncing_balls": make_bouncing_balls,
    "dense_fog": make_dense_fog,
    "fast_ball": make_fast_ball,
    "glossy_ball": make_glossy_ball,
    "jumping_ball": make_jumping_ball,
    "merging_balls": make_merging_balls,
    "opaque_wall": make_opaque_wall,
    "orbiting_balls": make_orbiting_balls,
    "pulsing_fog": make_pulsing_fog,
    "snowman": make_snowman,
    "static": make_static,
    "thin_rod": make_thin_rod,
    "twisting_block": make_twisting_block,
    "vanishing_ball": make_vanishing_ball,
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
    "Bend",
    "Body",
    "Bounce",
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
    "Jump",
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
    "Twist",
    "Vanish",
    "Warp",
    "Wave",
    "exact_flow",
    "exact_tracks",
    "first_surfaces",
    "grid_planes",
    "is_visible",
    "make_bending_rod",
    "make_bouncing_balls",
    "make_dense_fog",
    "make_fast_ball",
    "make_glossy_ball",
    "make_jumping_ball",
    "make_merging_balls",
    "make_opaque_wall",
    "make_orbiting_balls",
    "make_pulsing_fog",
    "make_scene",
    "make_snowman",
    "make_static",
    "make_thin_rod",
    "make_twisting_block",
    "make_vanishing_ball",
    "make_walker",
    "sector_planes",
]
