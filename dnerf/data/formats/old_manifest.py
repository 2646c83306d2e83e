"""Reading `transforms_*.json`: untrusted text to checked cameras, times and image paths. Nothing is executed."""

import json
import math
import os
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from reprlib import repr as short
from typing import Any

import torch
from torch import Tensor

from dnerf.core.cameras import PIXEL_OFFSETS, Intrinsics
from dnerf.data.frames import is_rigid

MAX_BYTES = 16 * 2**20
MAX_FRAMES = 10_000
SUFFIXES = (".png", ".jpg", ".jpeg")
DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")
PER_FRAME = ("camera_angle_x", "fl_x", "fl_y", "cx", "cy", "w", "h")
ANGLES = (1e-3, 3.14)
MAX_FOCAL_RATIO = 1e4
MAX_NUMBER = 1e9


@dataclass(frozen=True)
class Manifest:
    """What one `transforms_*.json` says, checked except for the images' contents."""

    path: Path  # the file, for messages
    fields: dict[str, Any]  # its top level without the frames
    images: tuple[Path, ...]  # F image files inside the data set's folder
    names: tuple[str, ...]  # F names as in the file, without extension
    poses: Tensor  # (F, 4, 4) float32, camera-to-world, rigid
    times: Tensor  # (F,) float32 in [0, 1]

    def number(self, field: str, low: float, high: float) -> float | None:
        """An optional top-level number, None if absent; ValueError if it is not a number in [low, high]."""
        if self.fields.get(field) is None:
            return None
        return _number(self.fields[field], f"{self.path}: {field}", low, high)

    def planes(self, near: float | None, far: float | None) -> tuple[float, float]:
        """z-depths where rays begin and end: the given ones, else the file's `near` and `far`, else 2 and 6."""
        found = []
        for field, given, default in (("near", near, 2.0), ("far", far, 6.0)):
            stated = self.number(field, 0, MAX_NUMBER) if given is None else given
            found.append(default if stated is None else float(stated))
        if not 0 <= found[0] < found[1] < math.inf:
            raise ValueError(f"{self.path}: near and far must satisfy 0 <= near < far, got {found[0]} and {found[1]}")
        return found[0], found[1]

    def background(self) -> tuple[float, float, float] | None:
        """What opaque images show behind the scene, if the file says; ValueError unless three numbers in [0, 1]."""
        color = self.fields.get("background")
        if color is None:
            return None
        if not isinstance(color, list) or len(color) != 3:
            raise ValueError(f"{self.path}: background must be a list of 3 numbers, got {short(color)}")
        red, green, blue = (_number(c, f"{self.path}: background[{i}]", 0, 1) for i, c in enumerate(color))
        return red, green, blue

    def pixel_origin(self) -> str:
        """Which point of a pixel its ray passes: the file's, else the centre; ValueError if the word is unknown."""
        word = self.fields.get("pixel_origin", "center")
        if not isinstance(word, str) or word not in PIXEL_OFFSETS:
            raise ValueError(f"{self.path}: pixel_origin must be one of {', '.join(PIXEL_OFFSETS)}, got {short(word)}")
        return word

    def intrinsics(self, width: int, height: int, pixel_origin: str) -> Intrinsics:
        """The camera of images of the given size, from `fl_x, fl_y, cx, cy` or else from `camera_angle_x`.

        Raises ValueError naming file and field, if neither is there, a value makes no sense, `w` or `h` is another
        size, or the lens is not a pinhole.
        """
        for field, size in (("w", width), ("h", height)):
            stated = self.number(field, 0, MAX_NUMBER)
            if stated is not None and stated != size:
                raise ValueError(f"{self.path}: {field} must be the images' {size}, got {stated:g}")
        for field in DISTORTIONS:
            if self.number(field, -MAX_NUMBER, MAX_NUMBER):
                raise ValueError(f"{self.path}: {field} must be 0: lens distortion is not supported")
        focal_range = (width / MAX_FOCAL_RATIO, width * MAX_FOCAL_RATIO)
        focal_x = self.number("fl_x", *focal_range)
        if focal_x is None:
            angle = self.number("camera_angle_x", *ANGLES)
            if angle is None:
                raise ValueError(f"{self.path}: camera_angle_x or fl_x must be given, got neither")
            focal_x = 0.5 * width / math.tan(0.5 * angle)
        focal_y = self.number("fl_y", *focal_range)
        focal_y = focal_x if focal_y is None else focal_y
        center_x, center_y = (self.number(field, -100 * n, 100 * n) for field, n in (("cx", width), ("cy", height)))
        return Intrinsics(width, height, focal_x, focal_y, center_x, center_y, pixel_origin)


def read_manifest(root: Path, split: str) -> Manifest:
    """Read and check `root/transforms_{split}.json`; ValueError in one line that names the file and the field."""
    path = root / f"transforms_{split}.json"
    fields = _read_json(path)
    if not isinstance(fields, dict):
        raise ValueError(f"{path}: must hold an object, got {short(fields)}")
    frames = fields.pop("frames", None)
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{path}: frames must be a list with at least one frame, got {short(frames)}")
    if len(frames) > MAX_FRAMES:
        raise ValueError(f"{path}: frames must be at most {MAX_FRAMES}, got {len(frames)}")
    real_root = os.path.realpath(root)
    images, names, poses, times = [], [], [], []
    for index, frame in enumerate(frames):
        where = f"{path}: frames[{index}]"
        if not isinstance(frame, dict):
            raise ValueError(f"{where} must be an object, got {short(frame)}")
        for field in PER_FRAME:
            if field in frame:
                raise ValueError(f"{where}.{field} must be at the top level: one camera per file is supported")
        name = _relative_name(_required(frame, "file_path", where), f"{where}.file_path")
        image = _find_image(root, real_root, name, f"{where}.file_path")
        images.append(image)
        names.append(name.removesuffix(image.suffix))
        times.append(_number(_required(frame, "time", where), f"{where}.time", 0, 1))
        poses.append(_matrix(_required(frame, "transform_matrix", where), f"{where}.transform_matrix"))
    matrices = torch.tensor(poses, dtype=torch.float64).float()
    for index in (~is_rigid(matrices)).nonzero()[:1, 0].tolist():
        raise ValueError(
            f"{path}: frames[{index}].transform_matrix must be rigid (an orthonormal, right-handed rotation, "
            f"finite entries and the last row 0 0 0 1), got {poses[index]}"
        )
    return Manifest(path, fields, tuple(images), tuple(names), matrices, torch.tensor(times))


def _read_json(path: Path) -> Any:
    try:
        status = path.stat()
        # Opening a pipe would wait for ever.
        if not stat.S_ISREG(status.st_mode):
            raise OSError("not a regular file")
        if status.st_size > MAX_BYTES:
            raise ValueError(f"{path}: file must be at most {MAX_BYTES // 2**20} MiB, got {status.st_size} bytes")
        with path.open("rb") as file:
            data = file.read(status.st_size)
    except FileNotFoundError:
        raise ValueError(f"{path}: file does not exist") from None
    except OSError as error:
        raise ValueError(f"{path}: file cannot be read: {error.strerror or error}") from error
    try:
        return json.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not UTF-8 at byte {error.start}") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: malformed JSON at line {error.lineno} column {error.colno}: {error.msg}") from None
    except RecursionError:
        raise ValueError(f"{path}: malformed JSON: nested too deeply") from None
    except ValueError as error:  # an integer of thousands of digits
        raise ValueError(f"{path}: malformed JSON: {error}") from None


def _required(frame: dict[str, Any], field: str, where: str) -> Any:
    if field not in frame:
        raise ValueError(f"{where}.{field} is missing")
    return frame[field]


def _number(value: Any, where: str, low: float, high: float) -> float:
    # bool is an int to Python, not to the format; and NaN fails the comparison.
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        raise ValueError(f"{where} must be a number in [{low:g}, {high:g}], got {short(value)}")
    return float(value)


def _matrix(value: Any, where: str) -> list[list[float]]:
    rows: Iterable[Any] = value if isinstance(value, list) and len(value) == 4 else [None]
    if not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise ValueError(f"{where} must be a list of 4 lists of 4 numbers, got {short(value)}")
    # The bound keeps later sums of squares finite in float32; real scenes lie within thousands.
    return [
        [_number(x, f"{where}[{i}][{j}]", -MAX_NUMBER, MAX_NUMBER) for j, x in enumerate(r)] for i, r in enumerate(rows)
    ]


def _relative_name(value: Any, where: str) -> str:
    """A path below the data set's folder in normal form, as far as the text alone can tell."""
    if not isinstance(value, str) or not value.isprintable():
        raise ValueError(f"{where} must be printable text, got {short(value)}")
    path = PurePosixPath(value)
    if path.is_absolute() or PureWindowsPath(value).drive or ".." in path.parts or not path.name:
        raise ValueError(f"{where} must stay inside the data set's folder, got {short(value)}")
    return str(path)


def _find_image(root: Path, real_root: str, name: str, where: str) -> Path:
    """The image file of that name, with or without extension, really inside the folder."""
    candidates = [name] if name.lower().endswith(SUFFIXES) else []
    for candidate in candidates + [name + suffix for suffix in SUFFIXES]:
        path = root / candidate
        if not os.path.exists(path):
            continue
        # Symbolic links may point elsewhere inside the folder, not out of it.
        if os.path.commonpath([os.path.realpath(path), real_root]) != real_root:
            raise ValueError(f"{where} must stay inside the data set's folder, got a link out of it: {name!r}")
        return path
    raise ValueError(f"{where}: no image {root / name} with extension {', '.join(SUFFIXES)}")
