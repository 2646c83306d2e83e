"""Film a model: camera paths and time paths, frames that survive a kill, films and raw arrays."""

from dnerf.sequences.films import (
    FILM_FORMATS,
    Share,
    render_frames_to,
    write_films,
    write_plan,
)
from dnerf.sequences.interpolation import interpolate
from dnerf.sequences.keyframes import KeyFrames, parse_key_frames, read_key_frames
from dnerf.sequences.rendering import OUTPUTS, check_outputs, deformation_magnitude, render_layers
from dnerf.sequences.store import FrameStore, write_npz
from dnerf.sequences.times import pingpong_times, slow_motion_times, sweep_times
from dnerf.sequences.views import View, make_views, sequence_digest

__all__ = [
    "FILM_FORMATS",
    "OUTPUTS",
    "FrameStore",
    "KeyFrames",
    "Share",
    "View",
    "check_outputs",
    "deformation_magnitude",
    "interpolate",
    "make_views",
    "parse_key_frames",
    "pingpong_times",
    "read_key_frames",
    "render_frames_to",
    "render_layers",
    "sequence_digest",
    "slow_motion_times",
    "sweep_times",
    "write_films",
    "write_npz",
    "write_plan",
]
