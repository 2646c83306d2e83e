"""The keys of `transforms*.json`: which are used, which are harmless, and which change the meaning and are refused."""

from collections.abc import Mapping
from typing import Any

from dnerf.data.formats.json_files import Notes, short

MATRIX_KEYS = ("K", "intrinsic_matrix")
TIME_KEYS = ("time", "timestamp", "frame_number", "frame_index", "frame_id", "frame")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
LENS_KEYS = {
    "camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model", "is_fisheye",
    *MATRIX_KEYS, *COEFFICIENTS,
}  # fmt: skip

USED = LENS_KEYS | {
    "frames", "near", "far", "background", "pixel_origin", "up", "ply_file_path",
    "train_filenames", "val_filenames", "test_filenames",
}  # fmt: skip
USED_BY_FRAME = LENS_KEYS | {"file_path", "transform_matrix", "mask_path", *TIME_KEYS}

# `applied_transform` and `applied_scale` say what has been done to poses and points alike: these are the file's units.
HARMLESS = {
    "aabb", "aabb_scale", "applied_scale", "applied_transform", "auto_scale_poses_override", "depth_path",
    "depth_unit_scale_factor", "enable_depth_loading", "flow_path", "frame_rate", "fps", "integer_depth_scale",
    "n_extra_learnable_dims", "n_frames", "name", "offset", "orientation_override", "scale", "version",
}  # fmt: skip
HARMLESS_BY_FRAME = {
    "appearance_id", "bg_depth", "camera_id", "camera_label_id", "colmap_im_id", "depth_file_path", "depth_path",
    "flow_path", "normal_file_path", "normal_path", "rotation", "semantics_path", "sharpness", "warp_id",
}  # fmt: skip

ROLLING = "this program knows no rolling shutter; export one transform_matrix per frame"
LENS = "this program knows pinhole, OPENCV and OPENCV_FISHEYE lenses; undistort the images and export those"
COLOR = "write an alpha channel into the images instead"
REFUSED = {
    "rolling_shutter": ROLLING, "transform_matrix_start": ROLLING, "transform_matrix_end": ROLLING,
    "latlong": LENS, "equirectangular": LENS, "ortho": LENS, "lens_mode": LENS,
    "ftheta_p0": LENS, "ftheta_p1": LENS, "ftheta_p2": LENS, "ftheta_p3": LENS, "ftheta_p4": LENS,
    "from_na": "this program reads OpenGL axes only; turn the poses to those when exporting",
    "from_mitsuba": "this program reads OpenGL axes only; turn the poses to those when exporting",
    "white_transparent": COLOR, "black_transparent": COLOR, "mask_color": COLOR,
}  # fmt: skip


def check_keys(fields: Mapping[str, Any], where: str, notes: Notes, place: str, *, of_frame: bool) -> None:
    """Refuse keys that change what a file means, and note those that nobody knows.

    Args:
        where: what `fields` is, for errors.
        place: the file, for notes.
        of_frame: whether these are fields of one frame rather than the file's own.

    Raises:
        ValueError: naming the key, and how to go on.
    """
    known = USED_BY_FRAME | HARMLESS_BY_FRAME if of_frame else USED | HARMLESS
    for key in sorted(fields.keys() - known):
        value = fields[key]
        if key not in REFUSED:
            kind = "a frame's key" if of_frame else "key"
            notes.add(f"{place}: {kind} {short(key)} is not known, it was ignored")
        elif value not in (None, False, 0, [], {}):
            raise ValueError(f"{where}.{key} cannot be followed, got {short(value)}: {REFUSED[key]}")
