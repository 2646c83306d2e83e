"""D-NeRF's format, `transforms_{split}.json` beside image folders: reading and writing.

The format is that of NeRF's Blender scenes (Mildenhall et al. 2020) with a `time` per frame (Pumarola et al. 2021).
"""

import json
import math
import os
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from dnerf.backgrounds import parse_color
from dnerf.checks import check_whole
from dnerf.data.frames import Frames
from dnerf.data.images import MAX_PIXELS, read_header, read_image, straight_alpha
from dnerf.data.manifest import Manifest, read_manifest

MAX_THREADS = 4


def load_blender(
    root: str | Path,
    split: str,
    resolution: int | None = None,
    *,
    near: float | None = None,
    far: float | None = None,
    pixel_origin: str | None = None,
    background: str | Sequence[float] | None = None,
    max_frames: int = 10_000,
    max_bytes: int = 8 * 2**30,
) -> Frames:
    """Read one split of a D-NeRF data set: `root/transforms_{split}.json` and its images.

    Images are decoded, premultiplied, averaged over pixel areas and rounded one at a time in each of up to four
    threads, so memory is that of the result and a few images (at most 2^25 pixels at once).

    Args:
        root: the scene's folder.
        split: "train", "val", "test" or any name that a file `transforms_{split}.json` has.
        resolution: width in pixels to reduce to, any ratio, height in proportion; the files' own if None. D-NeRF's
            protocol is 400 (from 800); its code averages straight colour, which differs at edges of low alpha.
        near: z-depth where rays begin; the file's `near`, else 2.
        far: z-depth where they end; the file's `far`, else 6.
        pixel_origin: "center" or "corner" rays; the file's, else "center".
        background: what images without alpha show behind the scene; the file's, else unknown. Images with alpha
            have none.
        max_frames: more frames than this are refused.
        max_bytes: pictures that would take more memory than this are refused before any is decoded.

    Returns:
        Frames with alpha if any image has it, opaque ones otherwise.

    Raises:
        ValueError: in one line that names the file and the field, for anything missing, malformed, out of range,
            too large, or outside the data set's folder.
    """
    root = Path(root)
    _check_split(split)
    if resolution is not None:
        check_whole("resolution", resolution)
    if not root.is_dir():
        raise ValueError(f"root must be a data set's folder, got {root}")
    manifest = read_manifest(root, split, max_frames)
    size, has_alpha = _common_header(manifest)
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
    frames = Frames(
        images,
        manifest.poses,
        manifest.times,
        manifest.intrinsics(*size, pixel_origin or manifest.pixel_origin()).resized(width, height),
        *manifest.planes(near, far),
        None if has_alpha else background or manifest.background(),
        manifest.names,
    )

    def fill(index: int) -> None:
        pixels = read_image(manifest.images[index], width=width, height=height, channels=channels, size=size)
        images[index] = torch.from_numpy(pixels)

    _in_threads(fill, len(manifest.images), min(MAX_THREADS, max(1, MAX_PIXELS // (size[0] * size[1]))))
    return frames


def check_blender(root: str | Path, split: str, max_frames: int = 10_000) -> None:
    """Read a split's `transforms_<split>.json` and the headers of its images, none of their pixels.

    Args:
        root: the scene's folder.
        split: see `load_blender`.
        max_frames: more frames than this are refused.

    Raises:
        ValueError: as `load_blender` for all that this tells.
    """
    _check_split(split)
    if not Path(root).is_dir():
        raise ValueError(f"root must be a data set's folder, got {root}")
    _common_header(read_manifest(Path(root), split, max_frames))


def save_blender(frames_by_split: Mapping[str, Frames], root: str | Path) -> None:
    """Write a data set that `load_blender` and the field's other codebases read.

    Images become PNG with straight alpha (`load_blender` restores the premultiplied pixels exactly), or RGB if they
    have none (D-NeRF's own loader expects alpha). Beyond D-NeRF's fields, files state `fl_x, fl_y, cx, cy, w, h,
    near, far` and, where not the default, `pixel_origin` and `background`. D-NeRF's code wants the splits train, val
    and test, and a first time of 0 in train.

    Everything is written to a temporary folder beside `root` that is renamed at the end: there is no half a data set.

    Args:
        frames_by_split: the frames of each split, by its name.
        root: the new folder; it must not exist or be empty.

    Raises:
        ValueError: if there are no splits, a name is not plain, colours exceed their alpha (not premultiplied), or
            `root` holds something.
    """
    root = Path(os.path.realpath(root))
    if not frames_by_split:
        raise ValueError("frames_by_split must hold at least one split, got none")
    for split, frames in frames_by_split.items():
        _check_split(split)
        for index, image in enumerate(frames.images if frames.has_alpha else ()):
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
        pixels = frames.images[index].cpu().numpy()
        picture = Image.fromarray(straight_alpha(pixels) if frames.has_alpha else pixels)
        picture.save(folder / f"{names[index]}.png")

    _in_threads(write, len(frames), MAX_THREADS)
    camera = frames.intrinsics
    fields: dict[str, Any] = {
        "camera_angle_x": 2 * math.atan(0.5 * camera.width / camera.focal_x),
        "fl_x": camera.focal_x,
        "fl_y": camera.focal_y,
        "cx": camera.center_x,
        "cy": camera.center_y,
        "w": camera.width,
        "h": camera.height,
        "near": frames.near,
        "far": frames.far,
        "pixel_origin": None if camera.pixel_origin == "center" else camera.pixel_origin,
        "background": None if frames.background is None else parse_color(frames.background),
    }
    fields = {name: value for name, value in fields.items() if value is not None}
    fields["frames"] = [
        {"file_path": name, "time": time, "transform_matrix": pose}
        for name, time, pose in zip(names, frames.times.tolist(), frames.poses.tolist())
    ]
    (folder / f"transforms_{split}.json").write_text(json.dumps(fields, indent=1, allow_nan=False))


def _check_split(split: str) -> None:
    if not re.fullmatch(r"\w[\w.-]*", split):
        raise ValueError(f"split must be a plain name such as train, got {split!r}")


def _common_header(manifest: Manifest) -> tuple[tuple[int, int], bool]:
    """The size that all images share, and whether any has alpha."""
    size, has_alpha = None, False
    for index, path in enumerate(manifest.images):
        width, height, alpha = read_header(path)
        size = size or (width, height)
        has_alpha |= alpha
        if size != (width, height):
            raise ValueError(
                f"{manifest.path}: frames[{index}].file_path: image must be {size[0]} x {size[1]} as the first, "
                f"got {width} x {height} in {path}"
            )
    assert size is not None
    return size, has_alpha


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
