"""Motion that a model has recovered: points carried through time, tracks, motion vectors of images."""

from dnerf.motion.transport import MotionModel, Tracks, carry, follow, motion_model
from dnerf.motion.vectors import MAX_RESIDUAL, MotionVectors, motion_vectors, render_motion

__all__ = [
    "MAX_RESIDUAL", "MotionModel", "MotionVectors", "Tracks", "carry", "follow", "motion_model", "motion_vectors",
    "render_motion",
]  # fmt: skip
