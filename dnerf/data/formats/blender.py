"""D-NeRF's format, `transforms_{split}.json` beside image folders: reading and writing.

The format is that of NeRF's Blender scenes (Mildenhall et al. 2020) with a `time` per frame (Pumarola et al. 2021).
"""

import json
import math
import os
import re
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from dnerf.core.backgrounds import parse_color
from dnerf.core.checks import check_whole
from dnerf.data.formats.manifest import Manifest, read_manifest
from dnerf.data.frames import Frames
from dnerf.data.images import MAX_PIXELS, is_transparent, read_header, read_image, straight_alpha

MAX_THREADS = 4


def load_blender(
    root: str | Path,
    split: str,
    resolution: int | None = None,
    *,
    near: float | None = None,
    far: float | None = None,
    pixel_origin: str | None = None,
    has_alpha: bool | None = None,
    max_bytes: int = 8 * 2**30,
) -> Frames:
    """Read one split of a D-NeRF data set: `root/transforms_{split}.json` and its images.

    Images are decoded, premultiplied, averaged over pixel areas and rounded one at a time in each of up to four
    threads, so memory is that of the result and a few images (at most 2^25 pixels at once).

    Args:
        split: "train", "val", "test" or any name that a file `transforms_{split}.json` has.
        resolution: width in pixels to reduce to, any ratio, height in proportion; the files' own if None. D-NeRF's
            protocol is 400 (from 800); its code averages straight colour, which differs at edges of low alpha.
        near: z-depth where rays begin; the file's `near`, else 2.
        far: z-depth where they end; the file's `far`, else 6.
        pixel_origin: "center" or "corner" rays; the file's, else "center".
        has_alpha: whether images are read with alpha. None decides by their pixels: only if any is not opaque, whatever
            the files' headers say. Splits of one data set should agree, see `has_transparency`.
        max_bytes: images that would take more memory than this are refused before any is decoded.

    Raises:
        ValueError: in one line that names the file and the field, for anything missing, malformed, out of range, too
            large, or outside the data set's folder; for transparent pixels where `has_alpha` is False.
    """
    root = Path(root)
    if resolution is not None:
        check_whole("resolution", resolution)
    manifest, size, may_have_alpha = _read_headers(root, split)
    if has_alpha is None:
        has_alpha = any(is_transparent(path) for path in may_have_alpha)
    width = size[0] if resolution is None else int(resolution)
    if width > size[0]:
        raise ValueError(
            f"resolution must be at most the images' width {size[0]} in {root}, or null for that, got {resolution}"
        )
    height = max(1, round(size[1] * width / size[0]))
    channels = 4 if has_alpha else 3
    num_bytes = len(manifest.images) * height * width * channels
    if num_bytes > max_bytes:
        raise ValueError(
            f"{manifest.path}: {len(manifest.images)} frames of {width} x {height} take {num_bytes} bytes, more than "
            f"max_bytes = {max_bytes}; lower resolution"
        )
    images = torch.empty(len(manifest.images), height, width, channels, dtype=torch.uint8)
    intrinsics = manifest.intrinsics(*size, pixel_origin or manifest.pixel_origin()).resized(width, height)
    background = None if has_alpha else manifest.background()
    planes = manifest.planes(near, far)
    frames = Frames(images, manifest.poses, manifest.times, intrinsics, *planes, background, manifest.names)

    def fill(index: int) -> None:
        pixels = read_image(manifest.images[index], width=width, height=height, channels=channels, size=size)
        images[index] = torch.from_numpy(pixels)

    _in_threads(fill, len(manifest.images), min(MAX_THREADS, max(1, MAX_PIXELS // (size[0] * size[1]))))
    return frames


def check_blender(root: str | Path, split: str) -> None:
    """Read a split's file and the headers of its images, none of their pixels; ValueError as `load_blender`."""
    _read_headers(Path(root), split)


def has_transparency(root: str | Path) -> bool:
    """Whether any pixel of the training images is not opaque: what decides if a data set is one with alpha.

    Images are decoded until one is found, none where no header says that there is alpha. ValueError as `load_blender`.
    """
    return any(is_transparent(path) for path in _read_headers(Path(root), "train")[2])


def save_blender(frames_by_split: Mapping[str, Frames], root: str | Path) -> None:
    """Write the frames of each split as a data set that `load_blender` and the field's other codebases read.

    Images become PNG with straight alpha (`load_blender` restores the premultiplied pixels exactly), or RGB if they
    have none (D-NeRF's own loader expects alpha). Beyond D-NeRF's fields, files state `fl_x, fl_y, cx, cy, w, h, near,
    far` and, where not the default, `pixel_origin` and `background`. D-NeRF's code wants the splits train, val and
    test, and a first time of 0 in train.

    Everything is written to a temporary folder beside `root` that is renamed at the end: there is no half a data set.

    Raises:
        ValueError: if there are no splits, a name is not plain, colours exceed their alpha (not premultiplied), or
            `root` holds something.
    """
    root = Path(os.path.realpath(root))
    if not frames_by_split:
        raise ValueError("frames_by_split must hold at least one split, got none")
    for split, frames in frames_by_split.items():
        _check_split(split)
        if frames.shared_intrinsics is None or frames.shared_intrinsics.distortion is not None:
            raise ValueError(f"frames_by_split[{split!r}] must share one pinhole, got other intrinsics")
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
        for split, frames in frames_by_split.items():
            _write_split(frames, split, folder)
        if root.is_dir():
            root.rmdir()
        folder.rename(root)


def _write_split(frames: Frames, split: str, folder: Path) -> None:
    (folder / split).mkdir(parents=True)
    names = [f"./{split}/r_{index:03d}" for index in range(len(frames))]

    def write(index: int) -> None:
        pixels = frames.stored_image(index).cpu().numpy()
        image = Image.fromarray(straight_alpha(pixels) if frames.has_alpha else pixels)
        image.save(folder / f"{names[index]}.png")

    _in_threads(write, len(frames), MAX_THREADS)
    camera = frames.intrinsics[0]
    fields: dict[str, Any] = {
        "camera_angle_x": 2 * math.atan(0.5 * camera.width / camera.focal_x), "fl_x": camera.focal_x,
        "fl_y": camera.focal_y, "cx": camera.center_x, "cy": camera.center_y, "w": camera.width, "h": camera.height,
        "near": frames.near, "far": frames.far,
        "pixel_origin": None if camera.pixel_origin == "center" else camera.pixel_origin,
        "background": None if frames.background is None else parse_color(frames.background),
    }  # fmt: skip
    fields = {name: value for name, value in fields.items() if value is not None}
    fields["frames"] = [
        {"file_path": name, "time": time, "transform_matrix": pose}
        for name, time, pose in zip(names, frames.times.tolist(), frames.poses.tolist())
    ]
    (folder / f"transforms_{split}.json").write_text(json.dumps(fields, indent=1, allow_nan=False))


def _check_split(split: str) -> None:
    if not re.fullmatch(r"\w[\w.-]*", split):
        raise ValueError(f"split must be a plain name such as train, got {split!r}")


def _read_headers(root: Path, split: str) -> tuple[Manifest, tuple[int, int], list[Path]]:
    """A split's manifest, the size that all of its images share, and those whose headers say that there is alpha."""
    _check_split(split)
    if not root.is_dir():
        raise ValueError(f"root must be a data set's folder, got {root}")
    manifest = read_manifest(root, split)
    size, may_have_alpha = None, []
    for index, path in enumerate(manifest.images):
        width, height, alpha = read_header(path)
        size = size or (width, height)
        may_have_alpha += [path] * alpha
        if size != (width, height):
            raise ValueError(
                f"{manifest.path}: frames[{index}].file_path: image must be {size[0]} x {size[1]} as the first, "
                f"got {width} x {height} in {path}"
            )
    assert size is not None
    return manifest, size, may_have_alpha


def _in_threads(work: Callable[[int], None], number: int, num_threads: int) -> None:
    """Call `work(0..number-1)` in threads; the first failure in that order is raised, the rest cancelled."""
    with ThreadPoolExecutor(num_threads) as pool:
        futures = [pool.submit(work, index) for index in range(number)]
        try:
            for future in futures:
                future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
