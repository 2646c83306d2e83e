"""COLMAP's sparse models (Schönberger and Frahm 2016) beside the images they were made of."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dnerf.core.cameras import Intrinsics
from dnerf.core.lenses import Distortion
from dnerf.data.capture import Capture, CaptureFrame, ImageFile
from dnerf.data.formats.colmap_model import CameraModel, RegisteredImage, read_cameras, read_images, read_points
from dnerf.data.formats.folder import Folder
from dnerf.data.formats.json_files import MAX_NUMBER, Notes, short
from dnerf.data.formats.manifest import uniquely_named
from dnerf.data.formats.manifest_cameras import MAX_FOCAL_RATIO, MAX_SIDE
from dnerf.data.formats.points import as_points
from dnerf.data.formats.poses import Pose, from_opencv, rigid_pose

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "")
IMAGE_FOLDERS = (
    "images", "images_2", "images_4", "images_8", "input", "rgb/1x", "rgb/2x", "rgb/4x", "rgb/8x", "rgb", ""
)  # fmt: skip


def recognises(root: Path) -> bool:
    """Whether a folder holds a model, itself or in `sparse/0`."""
    return _model_folder(root) is not None


def _model_folder(root: Path) -> Path | None:
    for name in MODEL_FOLDERS:
        for kind in ("bin", "txt"):
            if all((root / name / f"{part}.{kind}").exists() for part in ("cameras", "images")):
                return root / name
    return None


def read(root: Path) -> Capture:
    """The model's registered images in the order of their names, as one split; times are the numbers in their names.

    Raises:
        ValueError: in one line that names the file, for anything missing, malformed or out of range.
    """
    notes = Notes()
    folder, model = Folder(root, notes), _model_folder(root)
    if model is None:
        raise ValueError(f"{root}: no COLMAP model is there, looked for cameras and images, .bin or .txt, in sparse/0")
    folder.inside(model, str(model))
    images = sorted(read_images(model), key=lambda image: image.name)
    if not images:
        raise ValueError(f"{model}: the model has no registered image; export one that has")
    cameras = {
        number: _intrinsics(camera, f"{model}: camera {number}") for number, camera in read_cameras(model).items()
    }
    names = [_relative(image.name, str(model)) for image in images]
    place = _image_folder(folder, names)
    stems = [name.rpartition(".")[0] or name for name in names]
    times = folder.times(stems)
    frames = []
    for image, name, stem, time in zip(images, names, stems, times):
        where = f"{model}: image {short(image.name)}"
        if image.camera not in cameras:
            raise ValueError(f"{where}: camera {image.camera} is not in the model")
        path, _ = folder.image(f"{place}/{name}" if place else name, where)
        mask = root / "masks" / f"{name}.png"
        frames.append(
            CaptureFrame(
                stem, _pose(image, where), cameras[image.camera], ImageFile(path),
                folder.inside(mask, where) if mask.is_file() else None, time,
            )
        )  # fmt: skip
    return Capture(
        model, "colmap", {"all": uniquely_named(frames)}, points=as_points(read_points(model), str(model)),
        notes=notes.lines(),
    )  # fmt: skip


def _relative(name: str, where: str) -> str:
    """An image's name as a path below the folder of images."""
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".")]
    if not name.isprintable() or not parts or ".." in parts:
        raise ValueError(f"{where}: images' names must be paths below the folder of images, got {short(name)}")
    return "/".join(parts)


def _image_folder(folder: Folder, names: Sequence[str]) -> str:
    """The folder that holds most of the images, the larger ones first; ValueError if none holds any."""
    counts = {}
    for place in IMAGE_FOLDERS:
        if (folder.root / place).is_dir():
            counts[place] = sum((folder.root / place / name).is_file() for name in names)
    best = max(counts, key=lambda place: counts[place], default="")
    if not counts.get(best):
        raise ValueError(
            f"{folder.root}: none of the model's images is there, looked for images/{names[0]} and in "
            f"{', '.join(name for name in IMAGE_FOLDERS[1:] if name)}; put them into images/"
        )
    return best


def _pose(image: RegisteredImage, where: str) -> Pose:
    """Camera to world of a quaternion and translation that map world to camera."""
    values = np.array([*image.quaternion, *image.translation])
    bounded = bool((np.abs(values) <= MAX_NUMBER).all())  # false of NaN
    if not bounded or not np.linalg.norm(values[:4]) > 1e-6:
        raise ValueError(f"{where}: quaternion and translation must be finite, got {short(values.tolist())}")
    w, x, y, z = values[:4] / np.linalg.norm(values[:4])
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])  # Rodrigues' formula: R = I + 2 w [v] + 2 [v]^2
    rotation = np.eye(3) + 2 * w * across + 2 * across @ across
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ values[4:]
    return rigid_pose(from_opencv(pose), where, "images", Notes())


def _intrinsics(camera: CameraModel, where: str) -> Intrinsics:
    """A camera's intrinsics; ValueError for a lens that is not supported."""
    if not (1 <= camera.width <= MAX_SIDE and 1 <= camera.height <= MAX_SIDE):
        raise ValueError(f"{where}: width and height must be in 1..{MAX_SIDE}, got {camera.width} x {camera.height}")
    parameters = camera.parameters
    if camera.model not in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"):
        parameters = (parameters[0], *parameters)  # one focal length stands for both
    focal_x, focal_y, center_x, center_y, *rest = parameters
    for focal, size in ((focal_x, camera.width), (focal_y, camera.height)):
        if not size / MAX_FOCAL_RATIO <= focal <= size * MAX_FOCAL_RATIO:
            raise ValueError(f"{where}: focal length must fit {camera.width} x {camera.height}, got {focal:g}")
    try:
        distortion = _distortion(camera.model, rest)
        return Intrinsics(camera.width, camera.height, focal_x, focal_y, center_x, center_y, distortion=distortion)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _distortion(model: str, rest: Sequence[float]) -> Distortion | None:
    if model in ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"):
        return Distortion("fisheye", tuple(rest))
    if model in ("FOV", "THIN_PRISM_FISHEYE"):
        raise ValueError(f"lenses of {model} are not supported; run COLMAP's image_undistorter")
    if not any(rest):
        return None
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        return Distortion("opencv", tuple(rest))
    k1, k2, p1, p2, *more = rest
    return Distortion("opencv", (k1, k2, *more), (p1, p2))
