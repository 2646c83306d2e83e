"""D-NeRF's format as one split of frames; replaced by `read_capture`."""

import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from dnerf.core.checks import check_whole
from dnerf.data.formats.old_manifest import Manifest, read_manifest
from dnerf.data.frames import Frames
from dnerf.data.images import MAX_PIXELS, is_transparent, read_header, read_image

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
