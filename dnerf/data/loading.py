"""The frames of a capture to pixels in memory, and their intrinsics at the size of those pixels."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from dnerf.core.cameras import Intrinsics
from dnerf.core.checks import check_whole
from dnerf.data.capture import CaptureFrame, ImageFile
from dnerf.data.images import (
    MAX_PIXELS,
    Bytes,
    check_image,
    finish_image,
    has_shape,
    is_transparent,
    premultiplied_area_average,
    read_header,
    read_image,
    read_mask,
)
from dnerf.data.pixel_layout import MAX_MEMORY, empty_images
from dnerf.data.videos import read_frames, video_size

DEFAULT_WIDTH = 400  # in pixels, unless told: D-NeRF's protocol
MISSING = 10  # of so many images, fewer than one may be missing
NAMED = 8  # images that a note names
MAX_THREADS = 4
KEPT = 250  # of 255, from which on a pixel lies outside what a mask ignores: compressed masks are noisy


@dataclass(frozen=True, eq=False)
class LoadedFrames:
    """Frames whose images are there, and their pixels."""

    frames: tuple[CaptureFrame, ...]  # with intrinsics at the size of the pixels
    images: Tensor  # see `Frames.images`
    is_known: Tensor | None  # see `Frames.is_known`
    notes: tuple[str, ...]  # what was repaired, a line each

    @property
    def intrinsics(self) -> tuple[Intrinsics, ...]:
        """Of each frame."""
        return tuple(frame.intrinsics for frame in self.frames)

    @property
    def has_alpha(self) -> bool:
        """Whether the images have an alpha channel and so premultiplied colour."""
        return self.images.shape[-1] == 4


@dataclass(frozen=True)
class _Header:
    """How one frame's image is read."""

    frame: CaptureFrame  # with intrinsics at the final size
    image: ImageFile  # its own, which is there
    size: tuple[int, int]  # width and height, decoded
    may_have_alpha: bool = False
    is_upright: bool = True  # turned as its EXIF data say
    stated: tuple[int, int] | None = None  # width and height of the file's intrinsics, if the image has others


_Wanted = dict[int, list[tuple[_Header, Tensor]]]  # by frame of a video


def load_frames(
    frames: Sequence[CaptureFrame], *, resolution: int | None = None, has_alpha: bool | None = None,
    masks: str = "empty", max_memory: int = MAX_MEMORY,
) -> LoadedFrames:  # fmt: skip
    """Decode the images of frames, with their masks as alpha, and reduce them to a width.

    Images are decoded, premultiplied, averaged over pixel areas and rounded one at a time in each of up to four
    threads, so memory is that of the result and a few images. Videos are decoded once, from their first frame.

    Args:
        frames: each with an image.
        resolution: width in pixels to reduce to, height in proportion; narrower images stay as they are. The files'
            own, at most 400, if None.
        has_alpha: whether images have an alpha channel. None decides: if there are masks, or any pixel is not opaque,
            whatever the files' headers say. Splits of one data set should agree.
        masks: what lies where a mask is black: "empty" space, or what is "ignored", see `Frames.is_known`.
        max_memory: bytes of pixels beyond which they lie in a temporary file, see `empty_pixels`.

    Raises:
        ValueError: in one line that names the file, for images that are broken, too large, or of another shape than
            their intrinsics; for transparent pixels where `has_alpha` is False; where a tenth of the images or more are
            missing; if `resolution` is wider than all images.
    """
    if not frames:
        raise ValueError("frames must hold at least one, got none")
    present, notes = _present(frames)
    headers = [_header(frame, resolution) for frame in present]
    widest = max(header.size[0] for header in headers)
    if resolution is not None and resolution > widest:
        raise ValueError(
            f"resolution must be at most the images' width {widest}, or null for that, got {resolution}: "
            f"{headers[0].image.path}"
        )
    notes += _scaled_notes(headers)
    is_known = None
    if masks == "ignored":
        is_known = _known(headers)
        headers = [replace(header, frame=replace(header.frame, mask=None)) for header in headers]
    if has_alpha is None:
        masked = any(header.frame.mask is not None for header in headers)
        has_alpha = masked or any(is_transparent(header.image.path) for header in headers if header.may_have_alpha)
    sizes = [(header.frame.intrinsics.height, header.frame.intrinsics.width) for header in headers]
    images, parts = empty_images(sizes, 4 if has_alpha else 3, max_memory)
    largest = max(header.size[0] * header.size[1] for header in headers)
    in_threads(_tasks(headers, parts), min(MAX_THREADS, max(1, MAX_PIXELS // largest)))
    return LoadedFrames(tuple(header.frame for header in headers), images, is_known, notes)


def check_frames(frames: Sequence[CaptureFrame], *, resolution: int | None = None) -> None:
    """Raise ValueError as `load_frames` for files that are missing, broken or of another shape; no pixel is kept.

    Of videos only the headers are read.
    """
    headers = [_header(frame, resolution) for frame in _present(frames)[0]]
    paths = [header.image.path for header in headers if header.image.frame is None]
    paths += [header.frame.mask for header in headers if header.frame.mask is not None]
    in_threads([partial(check_image, path) for path in paths], MAX_THREADS)


def final_intrinsics(frame: CaptureFrame, resolution: int | None = None) -> Intrinsics:
    """The intrinsics that `load_frames` would give a frame, by its image's header; the stated size without an image."""
    if frame.image is None or not frame.image.path.exists():
        return _reduced(frame.intrinsics, resolution)
    return _header(frame, resolution).frame.intrinsics


def _present(frames: Sequence[CaptureFrame]) -> tuple[list[CaptureFrame], tuple[str, ...]]:
    """The frames whose images are there, and a note that names others."""
    present: list[CaptureFrame] = []
    missing: list[CaptureFrame] = []
    for frame in frames:
        if frame.image is None:
            raise ValueError(f"frames must have images, {frame.name} has none")
        (present if frame.image.path.exists() else missing).append(frame)
    if not missing:
        return present, ()
    paths = [str(frame.image.path) for frame in missing if frame.image is not None]
    if MISSING * len(missing) >= len(frames):
        raise ValueError(
            f"{paths[0]}: image does not exist, nor do {len(missing) - 1} others of {len(frames)}: add them, or take "
            f"their frames out of the file; fewer than one in {MISSING} may be missing"
        )
    rest = "" if len(missing) <= NAMED else f" and {len(missing) - NAMED} more"
    return present, (f"{len(missing)} of {len(frames)} images are missing, left out: {', '.join(paths[:NAMED])}{rest}",)


def _header(frame: CaptureFrame, resolution: int | None) -> _Header:
    """An image's size, and its frame with the intrinsics at the size to which it is to be reduced."""
    image, intrinsics, stated = frame.image, frame.intrinsics, None
    assert image is not None
    path, is_upright, may_have_alpha = image.path, True, False
    if image.frame is not None:
        size = video_size(path)
    else:
        width, height, may_have_alpha = read_header(path)
        size = (width, height)
        stored = read_header(path, upright=False)[:2]
        # Some programs work with images as they are stored; their intrinsics tell.
        if stored != size and stored == (intrinsics.width, intrinsics.height):
            size, is_upright = stored, False
    if (intrinsics.width, intrinsics.height) != size:
        stated = (intrinsics.width, intrinsics.height)
        if not has_shape(stated, size):
            raise ValueError(
                f"{path}: image must have the shape of its intrinsics, {stated[0]} x {stated[1]}, got {size[0]} x "
                f"{size[1]}: correct the file's width, height, focal lengths and principal point, or crop the image"
            )
        intrinsics = intrinsics.resized(*size)
    frame = replace(frame, intrinsics=_reduced(intrinsics, resolution))
    return _Header(frame, image, size, may_have_alpha, is_upright, stated)


def _reduced(intrinsics: Intrinsics, resolution: int | None) -> Intrinsics:
    if resolution is not None:
        check_whole("resolution", resolution)
    width = min(int(resolution or DEFAULT_WIDTH), intrinsics.width)
    if width == intrinsics.width:
        return intrinsics
    return intrinsics.resized(width, max(1, round(intrinsics.height * width / intrinsics.width)))


def _scaled_notes(headers: Sequence[_Header]) -> tuple[str, ...]:
    notes = []
    scaled = [(header, header.stated) for header in headers if header.stated is not None]
    if scaled:
        first, (width, height) = scaled[0]
        notes.append(
            f"intrinsics of {width} x {height} are scaled to images of {first.size[0]} x "
            f"{first.size[1]}, of {len(scaled)} frames: {first.image.path}"
        )
    if turned := [header for header in headers if not header.is_upright]:
        notes.append(
            f"{len(turned)} images are taken as they are stored, for their intrinsics have that size, not upright as "
            f"their EXIF data say: {turned[0].image.path}"
        )
    return tuple(notes)


def _tasks(headers: Sequence[_Header], parts: Sequence[Tensor]) -> list[Callable[[], None]]:
    """What fills the parts with pixels: one task for each image, then one for each video."""
    images: list[Callable[[], None]] = []
    videos: dict[Path, _Wanted] = {}
    for header, part in zip(headers, parts):
        path, number = header.image.path, header.image.frame
        if number is None:
            images.append(partial(_fill, header, part, partial(read_image, path, upright=header.is_upright)))
        else:
            videos.setdefault(path, {}).setdefault(number, []).append((header, part))
    return images + [partial(_fill_from_video, path, wanted) for path, wanted in videos.items()]


def _fill_from_video(path: Path, wanted: _Wanted) -> None:
    number = -1
    for number, pixels in enumerate(read_frames(path)):
        for header, part in wanted.pop(number, ()):
            _fill(header, part, partial(finish_image, pixels, path))
        if not wanted:
            return
    raise ValueError(f"{path}: video must have the frame {min(wanted)}, counted from 0, got {number + 1} frames")


def _known(headers: Sequence[_Header]) -> Tensor | None:
    """The pixels (P,) that masks keep whole; None if there is no mask."""
    if all(header.frame.mask is None for header in headers):
        return None
    parts = []
    for header in headers:
        width, height = header.frame.intrinsics.width, header.frame.intrinsics.height
        kept = torch.full((height, width), 255)
        if header.frame.mask is not None:
            mask = read_mask(header.frame.mask, header.size)
            kept = torch.from_numpy(premultiplied_area_average(mask[..., None], width, height)[..., 0])
        parts.append(kept.flatten() >= KEPT)
        if not bool(parts[-1].any()):
            raise ValueError(f"{header.frame.mask}: mask must leave a pixel of its image, got none: take its frame out")
    return torch.cat(parts)


def _fill(header: _Header, part: Tensor, read: Callable[..., Bytes]) -> None:
    height, width, channels = part.shape
    pixels = read(width=width, height=height, channels=channels, size=header.size, mask=header.frame.mask)
    part.copy_(torch.from_numpy(pixels))


def in_threads(tasks: Sequence[Callable[[], None]], num_threads: int) -> None:
    """Do tasks in threads; the first failure in their order is raised, the rest cancelled."""
    with ThreadPoolExecutor(num_threads) as pool:
        futures = [pool.submit(task) for task in tasks]
        try:
            for future in futures:
                future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
