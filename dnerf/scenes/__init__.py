"""Animated analytic scenes: radiance fields without parameters whose images and motions are known exactly."""

from collections.abc import Callable
from importlib import import_module

from dnerf.core.checks import check_choice
from dnerf.scenes.base import AnalyticScene, Body
from dnerf.scenes.exact_motion import ExactFlow, ExactTracks, exact_flow, exact_tracks, first_surfaces, is_visible
from dnerf.scenes.motions import Bounce, Fixed, Joint, Jump, Motion, Orbit, Pulse, Slide, Spin, Vanish, Wave
from dnerf.scenes.poses import Pose
from dnerf.scenes.shapes import Ball, Box, Capsule, Shape
from dnerf.scenes.textures import Checker, Glossy, Glow, Gradient, Lit, Plain, Shadowed, Stripes, Texture
from dnerf.scenes.warps import Bend, Twist, Warp

NAMES = (
    "bending_rod", "bouncing_balls", "courtyard", "dense_fog", "glossy_ball", "jumping_ball", "merging_balls",
    "opaque_wall", "orbiting_balls", "pulsing_fog", "snowman", "static", "thin_rod", "twisting_block", "vanishing_ball",
    "walker",
)  # fmt: skip
SCENES: dict[str, Callable[..., AnalyticScene]] = {
    name: getattr(import_module(f"dnerf.scenes.library.{name}"), f"make_{name}") for name in NAMES
}
"""Scenes by name: each a module of `dnerf.scenes.library` with a function `make_<name>`."""


def make_scene(name: str) -> AnalyticScene:
    """Return the scene of the given name.

    Raises:
        ValueError: for a name not in `SCENES`.
    """
    check_choice("scene", name, sorted(SCENES))
    return SCENES[name]()


__all__ = [
    "SCENES", "AnalyticScene", "Ball", "Bend", "Body", "Bounce", "Box", "Capsule", "Checker", "ExactFlow",
    "ExactTracks", "Fixed", "Glossy", "Glow", "Gradient", "Joint", "Jump", "Lit", "Motion", "Orbit", "Plain", "Pose",
    "Pulse", "Shadowed", "Shape", "Slide", "Spin", "Stripes", "Texture", "Twist", "Vanish", "Warp", "Wave",
    "exact_flow", "exact_tracks", "first_surfaces", "is_visible", "make_scene",
]  # fmt: skip
