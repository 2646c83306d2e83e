"""Intrinsics of `transforms*.json`, from the file's own fields and those of single frames, which come first."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dnerf.core.cameras import PIXEL_OFFSETS, Intrinsics
from dnerf.core.lenses import Distortion
from dnerf.data.formats.json_files import matrix, number, short, whole
from dnerf.data.formats.keys import COEFFICIENTS, MATRIX_KEYS

ANGLES = (1e-3, 3.14)
MAX_FOCAL_RATIO = 1e4
# A focal length below both is no pinhole's in pixels (a view of 170 degrees), but looks like one in widths.
MIN_FOCAL_RATIO = 0.04
MAX_SHARE = 10.0
MAX_SIDE = 2**17
MAX_COEFFICIENT = 1e4
MAX_SKEW = 1e-3  # of the focal length: a hundredth of a pixel in most images
MODELS = {
    "PINHOLE": "opencv", "SIMPLE_PINHOLE": "opencv", "PERSPECTIVE": "opencv", "SIMPLE_RADIAL": "opencv",
    "RADIAL": "opencv", "OPENCV": "opencv", "FULL_OPENCV": "opencv", "OPENCV_FISHEYE": "fisheye",
}  # fmt: skip


@dataclass(frozen=True)
class LensFields:
    """Fields about the camera of one frame."""

    frame: Mapping[str, Any]  # the frame's own fields
    shared: Mapping[str, Any]  # the file's
    frame_place: str  # the frame, for messages
    shared_place: str  # the file, for messages

    def find(self, key: str) -> tuple[Any, str]:
        """A field's value, None if it is nowhere, and its place."""
        if self.frame.get(key) is not None:
            return self.frame[key], f"{self.frame_place}.{key}"
        return self.shared.get(key), f"{self.shared_place}: {key}"

    def number(self, key: str, low: float, high: float) -> float | None:
        """A number in [low, high] or None; ValueError for another value."""
        value, place = self.find(key)
        return None if value is None else number(value, place, low, high)

    def stated_size(self) -> tuple[int, int] | None:
        """Width and height that `w` and `h` state, if both do."""
        (width, width_place), (height, height_place) = self.find("w"), self.find("h")
        if width is None or height is None:
            return None
        return whole(width, width_place, 1, MAX_SIDE), whole(height, height_place, 1, MAX_SIDE)

    def intrinsics(self, width: int, height: int) -> Intrinsics:
        """The camera at a size, the one stated or else the image's own.

        Focal lengths are those of `K`, or `fl_x, fl_y`, or the angles, and a frame's own of any kind come first. Pixels
        are square where only one focal length, or one angle, is given.

        Raises:
            ValueError: naming file and field, if none is there, a value makes no sense, or the lens is not supported.
        """
        for fields, place in ((self.frame, f"{self.frame_place}."), (self.shared, f"{self.shared_place}: ")):
            found = _focal_lengths(fields, place, width, height)
            if found is not None:
                break
        else:
            raise ValueError(
                f"{self.shared_place}: camera_angle_x, fl_x or K must be given, got none; "
                "add the horizontal field of view in radians, or the focal length in pixels"
            )
        focal_x, focal_y, center_x, center_y = found
        center_place = f"{place}K"
        if center_x is None or center_y is None:
            center_x = self.number("cx", -100 * width, 100 * width)
            center_y = self.number("cy", -100 * height, 100 * height)
            center_place = self.find("cx")[1]
        if 0 < (center_x or 0) <= 1 and 0 < (center_y or 0) <= 1 < min(width, height):
            raise ValueError(
                f"{center_place}: the principal point must be in pixels of images of {width} x {height}, got "
                f"{center_x:g}, {center_y:g}; multiply it by their width and height if these are shares"
            )
        if self.stated_size() is None and (center_x or 0) > 1.5 * width and (center_y or 0) > 1.5 * height:
            raise ValueError(
                f"{self.find('cx')[1]} and cy lie at {center_x:g}, {center_y:g}, far outside of images of "
                f"{width} x {height}; add w and h, the size that the intrinsics are meant at"
            )
        try:
            return Intrinsics(
                width, height, focal_x, focal_y, center_x, center_y, self._pixel_origin(), self._distortion()
            )
        except ValueError as error:
            if str(error).startswith((self.frame_place, self.shared_place)):
                raise
            raise ValueError(f"{self.frame_place}: {error}") from error

    def _pixel_origin(self) -> str:
        word = self.shared.get("pixel_origin", "center")
        if not isinstance(word, str) or word not in PIXEL_OFFSETS:
            raise ValueError(
                f"{self.shared_place}: pixel_origin must be one of {', '.join(PIXEL_OFFSETS)}, got {short(word)}"
            )
        return word

    def _distortion(self) -> Distortion | None:
        values = {key: self.number(key, -MAX_COEFFICIENT, MAX_COEFFICIENT) or 0.0 for key in COEFFICIENTS}
        model, name, place = self._model()
        radial = [values[f"k{order}"] for order in range(1, 7)]
        if model == "fisheye":
            extra = next((key for key in ("k5", "k6", "p1", "p2") if values[key]), None)
            if extra is not None:
                raise ValueError(f"{self.find(extra)[1]} must be 0 of a fisheye lens, got {values[extra]:g}")
            return Distortion("fisheye", tuple(radial[:4]))
        if not any(values.values()):
            return None
        if name in ("PINHOLE", "SIMPLE_PINHOLE"):
            raise ValueError(
                f"{place} must not be {name} with lens coefficients k1..p2 other than 0; "
                "write OPENCV, or remove the coefficients if the images are undistorted"
            )
        if radial[3] and name != "FULL_OPENCV":
            # nerfstudio's fourth coefficient multiplies r^8, OpenCV's divides by r^2.
            raise ValueError(
                f"{self.find('k4')[1]} must be 0 with camera_model {name or 'OPENCV'}, got {radial[3]:g}; "
                "write FULL_OPENCV if it is OpenCV's, or fit the lens with k1, k2 and k3"
            )
        while radial and not radial[-1]:
            radial.pop()
        return Distortion("opencv", tuple(radial), (values["p1"], values["p2"]))

    def _model(self) -> tuple[str, str, str]:
        """The kind of lens, the file's name for it, and where that stands."""
        word, place = self.find("camera_model")
        fisheye, fisheye_place = self.find("is_fisheye")
        if fisheye not in (None, True, False):
            raise ValueError(f"{fisheye_place} must be true or false, got {short(fisheye)}")
        if word is None:
            return ("fisheye" if fisheye else "opencv"), "", place
        name = word.upper() if isinstance(word, str) else ""
        if name not in MODELS:
            raise ValueError(
                f"{place} must be one of {', '.join(MODELS)}, got {short(word)}; undistort the images and export those"
            )
        if fisheye is not None and bool(fisheye) != (MODELS[name] == "fisheye"):
            raise ValueError(
                f"{fisheye_place} must agree with camera_model {name}, got {short(fisheye)}; remove one of the two"
            )
        return MODELS[name], name, place


def _focal_lengths(
    fields: Mapping[str, Any], place: str, width: int, height: int
) -> tuple[float, float, float | None, float | None] | None:
    """Focal lengths, and the principal point where a matrix has it; None if these fields have no focal length."""
    for key in MATRIX_KEYS:
        if fields.get(key) is not None:
            return _of_matrix(fields[key], f"{place}{key}", width, height)
    found = []
    for axis, size in (("y", height), ("x", width)):
        for key, focal_length in ((f"fl_{axis}", _in_pixels), (f"camera_angle_{axis}", _of_angle)):
            if fields.get(key) is not None:
                found.append(focal_length(fields[key], f"{place}{key}", size))
                break
    return (found[-1], found[0], None, None) if found else None  # one may stand for both


def _in_pixels(value: Any, place: str, size: int) -> float:
    focal = number(value, place, size / MAX_FOCAL_RATIO, size * MAX_FOCAL_RATIO)
    if focal < min(MAX_SHARE, MIN_FOCAL_RATIO * size):
        raise ValueError(
            f"{place} must be in pixels of images {size} across, got {focal:g}; multiply it by {size} if it is a share"
        )
    return focal


def _of_angle(value: Any, place: str, size: int) -> float:
    if isinstance(value, int | float) and ANGLES[1] < value < 180:
        raise ValueError(f"{place} must be in radians, below pi, got {value:g}; that may be {math.radians(value):.6g}")
    return 0.5 * size / math.tan(0.5 * number(value, place, *ANGLES))


def _of_matrix(value: Any, place: str, width: int, height: int) -> tuple[float, float, float, float]:
    values = matrix(value, place, ((3, 3), (3, 4), (4, 4)))
    focal_x = _in_pixels(float(values[0, 0]), f"{place}[0][0]", width)
    focal_y = _in_pixels(float(values[1, 1]), f"{place}[1][1]", height)
    if abs(values[0, 1]) > MAX_SKEW * focal_x:
        raise ValueError(f"{place}[0][1] must be 0, got {values[0, 1]:g}: pixels without skew are supported only")
    if values[1, 0] or values[2, :3].tolist() != [0, 0, 1]:
        raise ValueError(f"{place} must have the rows fx 0 cx, 0 fy cy and 0 0 1, got {short(value)}")
    return focal_x, focal_y, float(values[0, 2]), float(values[1, 2])
