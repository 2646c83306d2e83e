"""Films of a model: camera and time paths, frames that survive a kill, images of depth and motion, and their files."""

from dnerf.core.geometry import box_planes
from dnerf.visualization.camera_paths import fixed_path, pose_around, spiral_path
from dnerf.visualization.colours import colorize, error_map, flow_colors, flow_image, scaled_image
from dnerf.visualization.data_sheet import data_sheet
from dnerf.visualization.films import FILM_FORMATS, empty_frames, render_frames_to, write_films, write_plan
from dnerf.visualization.frame_outputs import OUTPUTS, check_outputs, deformation_magnitude, render_layers
from dnerf.visualization.frame_store import FrameStore, write_npz
from dnerf.visualization.interpolation import interpolate
from dnerf.visualization.key_frames import KeyFrames, parse_key_frames, read_key_frames
from dnerf.visualization.surroundings import Surroundings
from dnerf.visualization.time_paths import film_times, pingpong_times, sweep_times
from dnerf.visualization.tracks import draw_tracks, render_tracks, visible_points
from dnerf.visualization.video import comparison_sheet, contact_sheet, write_frames, write_png
from dnerf.visualization.views import View, make_views, sequence_digest

__all__ = [
    "FILM_FORMATS", "OUTPUTS", "FrameStore", "KeyFrames", "Surroundings", "View", "box_planes", "check_outputs",
    "colorize", "comparison_sheet", "contact_sheet", "data_sheet", "deformation_magnitude", "draw_tracks",
    "empty_frames", "error_map", "film_times", "fixed_path", "flow_colors", "flow_image", "interpolate", "make_views",
    "parse_key_frames", "pingpong_times", "pose_around", "read_key_frames", "render_frames_to",
    "render_layers", "render_tracks", "scaled_image", "sequence_digest", "spiral_path", "sweep_times", "visible_points",
    "write_films", "write_frames", "write_npz", "write_plan", "write_png",
]  # fmt: skip
