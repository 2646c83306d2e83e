"""Writing a data set: D-NeRF's format, and nerfstudio's."""

import math
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from PIL import Image

from dnerf.core.backgrounds import parse_color
from dnerf.core.cameras import Intrinsics
from dnerf.core.checks import check_choice
from dnerf.core.files import write_json
from dnerf.data.capture import SPLITS
from dnerf.data.formats.keys import COEFFICIENTS
from dnerf.data.frames import Frames
from dnerf.data.images import straight_alpha
from dnerf.data.loading import MAX_THREADS, in_threads


def save_blender(frames_by_split: Mapping[str, Frames], root: str | Path) -> None:
    """Write the frames of each split as a data set in D-NeRF's format, as the field's other codebases read it.

    Images become PNG with straight alpha, of which the premultiplied pixels come back exactly, or RGB if they have none
    (D-NeRF's own loader expects alpha). Beyond D-NeRF's fields, files state `fl_x, fl_y, cx, cy, w, h, near, far` and,
    where not the default, `pixel_origin` and `background`. D-NeRF's code wants the splits train, val and test, and a
    first time of 0 in train.

    Everything is written to a temporary folder beside `root` that is renamed at the end: there is no half a data set.

    Raises:
        ValueError: if there are no splits, a name is not plain, colours exceed their alpha (not premultiplied), cameras
            differ within a split or are no pinholes, or `root` holds something.
    """
    for split, frames in frames_by_split.items():
        if not re.fullmatch(r"\w[\w.-]*", split):
            raise ValueError(f"split must be a plain name such as train, got {split!r}")
        if frames.shared_intrinsics is None or frames.shared_intrinsics.distortion is not None:
            raise ValueError(
                f"frames_by_split[{split!r}] must share one pinhole in D-NeRF's format, got other intrinsics; "
                "save_transforms writes them"
            )

    with _new_folder(frames_by_split, root) as folder:
        for split, frames in frames_by_split.items():
            names = [f"./{split}/r_{index:03d}" for index in range(len(frames))]
            _write_images(frames, [f"{name}.png" for name in names], folder)
            camera = frames.intrinsics[0]
            angle = 2 * math.atan(0.5 * camera.width / camera.focal_x)
            fields = {"camera_angle_x": angle, **_lens(camera), **_shared(frames), "frames": _listed(frames, names)}
            write_json(folder / f"transforms_{split}.json", fields)


def save_transforms(frames_by_split: Mapping[str, Frames], root: str | Path) -> None:
    """Write frames as one `transforms.json` in nerfstudio's format, with a `time` per frame.

    Cameras may differ and have lenses. The file lists the names of each split, and, for this program, `near`, `far`,
    `pixel_origin` and `background` where not the default. Images and `root` are as in `save_blender`.

    Raises:
        ValueError: as `save_blender`; for other splits than train, val and test, none for training, fisheye lenses
            together with others, or splits that differ in what the file says once.
    """
    cameras: list[Intrinsics] = [camera for frames in frames_by_split.values() for camera in frames.intrinsics]
    for split in frames_by_split:
        check_choice("split", split, SPLITS)
    if frames_by_split and "train" not in frames_by_split:
        raise ValueError(f"frames_by_split must have a train split, got {', '.join(frames_by_split)}")
    shared = [_shared(frames) for frames in frames_by_split.values()]
    if any(other != shared[0] for other in shared) or len({camera.pixel_origin for camera in cameras}) > 1:
        raise ValueError("near, far, pixel_origin and background must be the same in all of frames_by_split")
    lens_model(cameras)  # checks them

    lists: dict[str, Any] = {}
    listed: list[dict[str, Any]] = []
    with _new_folder(frames_by_split, root) as folder:
        for split, frames in frames_by_split.items():
            names = [f"images/{split}_{index:05d}.png" for index in range(len(frames))]
            _write_images(frames, names, folder)
            lists[f"{split}_filenames"] = names
            listed += _listed(frames, names)
        write_json(folder / "transforms.json", transforms_fields(listed, cameras, shared[0] | lists))


def transforms_fields(
    listed: Sequence[Mapping[str, Any]], cameras: Sequence[Intrinsics], shared: Mapping[str, Any]
) -> dict[str, Any]:
    """What a `transforms.json` in nerfstudio's format holds, with the lens once if all frames share it.

    Args:
        listed: by frame `file_path`, `transform_matrix` and `time`.
        cameras: of each frame.
        shared: what the file says of all of them besides.

    Raises:
        ValueError: for fisheye lenses together with others.
    """
    one = len(set(cameras)) == 1
    frames = [dict(frame) | ({} if one else _lens(camera)) for frame, camera in zip(listed, cameras)]
    return {"camera_model": lens_model(cameras), **(_lens(cameras[0]) if one else {}), **shared, "frames": frames}


def lens_model(cameras: Sequence[Intrinsics]) -> str:
    """COLMAP's name of the lenses of a file, which has one for all; ValueError for fisheye lenses among others."""
    models = {"opencv" if camera.distortion is None else camera.distortion.model for camera in cameras}
    if len(models) > 1:
        raise ValueError("frames_by_split must have fisheye lenses only, or none")
    if models == {"fisheye"}:
        return "OPENCV_FISHEYE"
    is_full = any(camera.distortion is not None and any(camera.distortion.coefficients[3:6]) for camera in cameras)
    return "FULL_OPENCV" if is_full else "OPENCV"


@contextmanager
def _new_folder(frames_by_split: Mapping[str, Frames], root: str | Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `root` when the block ends well; ValueError for frames not to be saved."""
    root = Path(os.path.realpath(root))
    if not frames_by_split:
        raise ValueError("frames_by_split must hold at least one split, got none")
    for split, frames in frames_by_split.items():
        for index in range(len(frames) if frames.has_alpha else 0):
            image = frames.stored_image(index)
            # One level above is what rounding of equal floats can leave; it is clamped.
            if bool((image[..., :3].short() > image[..., 3:].short() + 1).any()):
                raise ValueError(
                    f"frames_by_split[{split!r}] must be premultiplied, got colours above their alpha in frame {index}"
                )
    if os.path.lexists(root) and not (root.is_dir() and not any(root.iterdir())):
        raise ValueError(f"root must be a new or empty folder, got {root}")
    root.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{root.name}.", dir=root.parent) as temporary:
        # A folder inside the temporary one has the usual permissions; the temporary one itself is private.
        folder = Path(temporary) / root.name
        folder.mkdir()
        yield folder
        if root.is_dir():
            root.rmdir()
        folder.rename(root)


def _write_images(frames: Frames, names: list[str], folder: Path) -> None:
    (folder / names[0]).parent.mkdir(parents=True, exist_ok=True)

    def write(index: int) -> None:
        pixels = frames.stored_image(index).cpu().numpy()
        image = Image.fromarray(straight_alpha(pixels) if frames.has_alpha else pixels)
        image.save(folder / names[index])

    in_threads([partial(write, index) for index in range(len(frames))], MAX_THREADS)


def _listed(frames: Frames, names: list[str]) -> list[dict[str, Any]]:
    """What a file says of each frame."""
    return [
        {"file_path": name, "time": time, "transform_matrix": pose}
        for name, time, pose in zip(names, frames.times.tolist(), frames.poses.tolist())
    ]


def _shared(frames: Frames) -> dict[str, Any]:
    """What a file says of all of its frames."""
    fields: dict[str, Any] = {"near": frames.near, "far": frames.far}
    if frames.intrinsics[0].pixel_origin != "center":
        fields["pixel_origin"] = frames.intrinsics[0].pixel_origin
    if frames.background is not None:
        fields["background"] = parse_color(frames.background)
    return fields


def _lens(camera: Intrinsics) -> dict[str, Any]:
    lens = {
        "fl_x": camera.focal_x, "fl_y": camera.focal_y, "cx": camera.center_x, "cy": camera.center_y, "w": camera.width,
        "h": camera.height,
    }  # fmt: skip
    coefficients = camera.distortion.coefficients if camera.distortion else (0.0,) * 8
    lens |= {key: value for key, value in zip(COEFFICIENTS, coefficients) if value}
    return {key: value for key, value in lens.items() if value is not None}
