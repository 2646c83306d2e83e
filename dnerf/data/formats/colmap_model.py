"""COLMAP's models, text and binary: cameras, registered images and points, as untrusted bytes.

Source: https://colmap.github.io/format.html and `src/colmap/scene/reconstruction_io.cc`.
"""

import io
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dnerf.data.formats.json_files import MAX_FRAMES, MAX_NUMBER, read_bytes, short
from dnerf.data.formats.points import MAX_POINTS

MAX_BYTES = 2**29
MAX_NAME = 4096
# Names by the binary format's number, with the number of parameters.
MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
)  # fmt: skip


@dataclass(frozen=True)
class CameraModel:
    """A line of `cameras.txt`."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class RegisteredImage:
    """A first line of `images.txt`: world to camera, OpenCV's axes."""

    name: str
    camera: int
    quaternion: tuple[float, ...]  # w, x, y, z
    translation: tuple[float, ...]


class Bytes:
    """Reads a file's bytes from front to back; ValueError naming the file where they end too early."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.place = path, read_bytes(path, MAX_BYTES), 0

    def take(self, layout: str) -> tuple:
        """Values of a `struct` layout."""
        place = self.place
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self.data, place)

    def count(self, most: int, least_bytes: int, what: str) -> int:
        """A number of entries, each of at least so many bytes; ValueError if the file cannot hold them."""
        (found,) = self.take("<Q")
        if found > most or found * least_bytes > len(self.data) - self.place:
            raise ValueError(f"{self.path}: {what} must be at most {most} and within the file, got {found}")
        return found

    def skip(self, size: int) -> None:
        """Leave out so many bytes."""
        if size > len(self.data) - self.place:
            raise ValueError(f"{self.path}: file is truncated at byte {self.place}")
        self.place += size

    def name(self) -> str:
        """Text up to a zero byte."""
        end = self.data.find(b"\0", self.place, self.place + MAX_NAME)
        if end < 0:
            raise ValueError(f"{self.path}: name at byte {self.place} must end within {MAX_NAME} bytes")
        name = self.data[self.place : end].decode("utf-8", "replace")
        self.place = end + 1
        return name


def read_cameras(folder: Path) -> dict[int, CameraModel]:
    """Cameras by number, from `cameras.bin` or `cameras.txt`."""
    cameras: dict[int, CameraModel] = {}
    if (folder / "cameras.bin").exists():
        data = Bytes(folder / "cameras.bin")
        for _ in range(data.count(MAX_FRAMES, 48, "cameras")):
            number, model, width, height = data.take("<iiQQ")
            if not 0 <= model < len(MODELS):
                raise ValueError(f"{data.path}: camera {number} must be of a known model, got number {model}")
            name, count = MODELS[model]
            cameras[number] = _checked(CameraModel(name, width, height, data.take(f"<{count}d")), data.path)
        return cameras
    path = folder / "cameras.txt"
    for line, words in _lines(path):
        if not words:
            continue
        try:
            values = tuple(float(word) for word in words[4:])
            camera = CameraModel(words[1], int(words[2]), int(words[3]), values)
            cameras[int(words[0])] = _checked(camera, path)
        except (IndexError, ValueError) as error:
            raise ValueError(f"{path}: line {line} must be number, model, width, height, parameters: {error}") from None
        if len(cameras) > MAX_FRAMES:
            raise ValueError(f"{path}: cameras must be at most {MAX_FRAMES}")
    return cameras


def read_images(folder: Path) -> list[RegisteredImage]:
    """Registered images, in the file's order, from `images.bin` or `images.txt`."""
    if (folder / "images.bin").exists():
        data, images = Bytes(folder / "images.bin"), []
        for _ in range(data.count(MAX_FRAMES, 73, "images")):
            values = data.take("<i7di")
            name = data.name()
            data.skip(24 * data.count(2**40, 24, "points of an image"))
            images.append(RegisteredImage(name, values[8], values[1:5], values[5:8]))
        return images
    return _images_of_text(folder / "images.txt")


def _images_of_text(path: Path) -> list[RegisteredImage]:
    """Two lines for each image, of which the second has its points, is empty, or is left out by some exporters."""
    images: list[RegisteredImage] = []
    after_image = False
    for line, words in _lines(path):
        if not words or (after_image and len(words) % 3 == 0 and all(map(_is_number, words[:9]))):
            after_image = False
            continue
        try:
            numbers = tuple(float(word) for word in words[1:8])
            images.append(RegisteredImage(" ".join(words[9:]), int(words[8]), numbers[:4], numbers[4:]))
        except (IndexError, ValueError) as error:
            raise ValueError(
                f"{path}: line {line} must be number, quaternion, translation, camera, name: {str(error)[:80]}"
            ) from None
        after_image = True
        if len(images) > MAX_FRAMES:
            raise ValueError(f"{path}: images must be at most {MAX_FRAMES}")
    return images


def read_points(folder: Path) -> np.ndarray:
    """Positions (N, 3) from `points3D.bin` or `points3D.txt`, the first 200,000; none where there is no file."""
    if (folder / "points3D.bin").exists():
        data, rows = Bytes(folder / "points3D.bin"), []
        for _ in range(min(MAX_POINTS, data.count(2**40, 51, "points"))):
            rows.append(data.take("<Q3d3Bd")[1:4])
            data.skip(8 * data.count(2**40, 8, "track of a point"))
        return np.array(rows, dtype=np.float64).reshape(-1, 3)
    path, rows = folder / "points3D.txt", []
    if not path.exists():
        return np.zeros((0, 3))
    for line, words in _lines(path, max_words=4):
        if len(rows) == MAX_POINTS:
            break
        if words:
            if len(words) < 4 or not all(map(_is_number, words[1:4])):
                raise ValueError(f"{path}: line {line} must begin with a number and a position")
            rows.append(tuple(float(word) for word in words[1:4]))
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _lines(path: Path, max_words: int = 2**20) -> Iterator[tuple[int, list[str]]]:
    """Numbers and words of a text file's lines, comments left out."""
    for number, line in enumerate(io.BytesIO(read_bytes(path, MAX_BYTES)), start=1):
        words = line.decode("utf-8", "replace").split(maxsplit=max_words)
        if not (words and words[0].startswith("#")):
            yield number, words


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _checked(camera: CameraModel, path: Path) -> CameraModel:
    known = dict(MODELS)
    if camera.model not in known:
        raise ValueError(f"model must be one of {', '.join(known)}, got {short(camera.model)}")
    if len(camera.parameters) != known[camera.model]:
        raise ValueError(f"{camera.model} must have {known[camera.model]} parameters, got {len(camera.parameters)}")
    if not all(math.isfinite(value) and abs(value) <= MAX_NUMBER for value in camera.parameters):
        raise ValueError(f"{path}: a camera's parameters must be finite, got {camera.parameters}")
    return camera
