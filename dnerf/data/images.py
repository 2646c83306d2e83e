"""Image files to premultiplied uint8 pixels of a chosen size: untrusted bytes in, exact area averages out."""

import stat
import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFile

from dnerf.data.file_kinds import HEAD, what_else

MAX_PIXELS = 2**25
MAX_SIDE = 2**14
FORMATS = ("PNG", "JPEG")
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "I;16")
BAND_PIXELS = 2**15
ORIENTATION = 0x0112  # tag of EXIF: how an image as stored is turned upright
TURNED = (5, 6, 7, 8)  # its values that swap width and height

Bytes = NDArray[np.uint8]


def read_header(path: Path, *, upright: bool = True) -> tuple[int, int, bool]:
    """Width, height and whether an image file has alpha, without decoding it; turned as its EXIF data say if `upright`.

    Raises ValueError naming the file, if it is missing, not a PNG or JPEG, or larger than 2^25 pixels or 2^14 on a
    side.
    """
    with _open(path) as image:
        try:
            width, height = image.size
            if upright and _orientation(image) in TURNED:
                width, height = height, width
            return width, height, image.has_transparency_data
        except AssertionError as error:
            raise ValueError(f"{path}: image has colours of a palette, but no palette") from error


def check_image(path: Path) -> None:
    """Raise ValueError as `read_image` of a file that is missing or broken, mostly without decoding it.

    A PNG's bytes are compared with their check sums first; a JPEG is decoded at an eighth of its size.
    """
    with _open(path) as image, suppress(Exception):  # hostile bytes raise many types, see `_decoded`
        if image.format == "PNG":
            image.verify()
            return
    with _open(path) as image:
        image.draft(None, (1, 1))
        _decoded(image, path, with_alpha=False)


def read_image(
    path: Path, *, width: int, height: int, channels: int, size: tuple[int, int], mask: Path | None = None,
    upright: bool = True,
) -> Bytes:  # fmt: skip
    """Decode an image, premultiply by alpha, average over pixel areas and round once: (height, width, channels) uint8.

    Palettes and grey are expanded to colour, 16 bits rounded to 8.

    Args:
        path: a PNG or JPEG file of `size`, (width, height).
        width: columns of the result, at most the file's.
        height: rows of the result, at most the file's.
        channels: 4 for premultiplied colour and alpha, 3 for an image that is opaque everywhere.
        mask: an image file that multiplies alpha, see `read_mask`.
        upright: whether to turn the image as its EXIF data say; `size` is that of the turned one.

    Raises:
        ValueError: naming the file, as `read_header`, or if it is truncated, of another size, or transparent somewhere
            where `channels` is 3.
    """
    with _open(path) as image:
        pixels = _decoded(image, path, with_alpha=channels == 4)
        if upright:
            pixels = _turned(pixels, _orientation(image))
    return finish_image(pixels, path, width=width, height=height, channels=channels, size=size, mask=mask)


def finish_image(
    pixels: Bytes, path: Path, *, width: int, height: int, channels: int, size: tuple[int, int], mask: Path | None
) -> Bytes:
    """What `read_image` does with decoded pixels (H, W, 3 or 4) of straight alpha."""
    if pixels.shape[1::-1] != size:
        raise ValueError(f"{path}: image must be {size[0]} x {size[1]}, got {pixels.shape[1]} x {pixels.shape[0]}")
    if mask is not None:
        kept = read_mask(mask, size)
        if pixels.shape[-1] == 4:
            kept = ((pixels[..., 3].astype(np.uint16) * kept + 127) // 255).astype(np.uint8)
        pixels = np.concatenate([pixels[..., :3], kept[..., None]], axis=-1)
    if pixels.shape[-1] > channels:
        if pixels[..., 3].min() < 255:
            raise ValueError(
                f"{mask or path}: image must be opaque, as the training images are, got transparent pixels"
            )
        pixels = pixels[..., :channels]
    elif pixels.shape[-1] < channels:
        pixels = np.pad(pixels, ((0, 0), (0, 0), (0, 1)), constant_values=255)
    return premultiplied_area_average(pixels, width, height)


def read_mask(path: Path, size: tuple[int, int]) -> Bytes:
    """What an image file keeps of an image of `size`, (width, height): (height, width) uint8, 255 is all.

    It is the file's brightness times its alpha. A larger file is averaged over pixel areas; ValueError, naming the
    file, for a smaller one or another shape.
    """
    with _open(path) as image:
        pixels = _turned(_decoded(image, path, with_alpha=True), _orientation(image))
    # Colours stand for the brightest of their channels, for masks are drawn in any.
    kept = pixels[..., :3].max(-1).astype(np.uint16) * pixels[..., 3]
    mask = ((kept + 127) // 255).astype(np.uint8)
    width, height = size
    if not has_shape((mask.shape[1], mask.shape[0]), size) or mask.shape[0] < height or mask.shape[1] < width:
        raise ValueError(
            f"{path}: mask must be {width} x {height} as its image, or larger and of that shape, "
            f"got {mask.shape[1]} x {mask.shape[0]}"
        )
    return premultiplied_area_average(mask[..., None], width, height)[..., 0]


def has_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes (width, height) are of one image, enlarged or reduced and rounded to whole pixels."""
    return abs(size[0] * other[1] - size[1] * other[0]) < max(sum(size), sum(other))


def is_transparent(path: Path) -> bool:
    """Whether any pixel of an image is not opaque: its header tells only that one may be; fails as `read_image`."""
    with _open(path) as image:
        return bool(_decoded(image, path, with_alpha=True)[..., 3].min() < 255)


def premultiplied_area_average(pixels: Bytes, width: int, height: int) -> Bytes:
    """Mean over pixel areas of colour times alpha (and of alpha), exact until one rounding to 8 bits.

    Source pixel i covers [i m, (i + 1) m) and target pixel j covers [j n, (j + 1) n) when n pixels become m, so all
    weights are integers and the sums are exact.

    Args:
        pixels: (H, W, 3) colour or (H, W, 4) colour and straight alpha, uint8, of which (height, width, 3 or 4) are
            made.
        width: columns of the result, in 1..W; ValueError otherwise.
        height: rows of the result, in 1..H.
    """
    source_height, source_width, channels = pixels.shape
    if not (0 < width <= source_width and 0 < height <= source_height):
        raise ValueError(
            f"width and height must be in 1..{source_width} and 1..{source_height}, got {width} and {height}"
        )
    if channels == 3 and (height, width) == pixels.shape[:2]:
        return np.array(pixels)
    area = (source_height // height) * (source_width // width)
    whole = source_height % height == 0 and source_width % width == 0 and area * 255 * 255 < 2**31
    divisor = area if whole else source_height * source_width
    result = np.empty((height, width, channels), np.uint8)
    # Bands of rows keep the wide integers small and in the cache.
    band = max(1, BAND_PIXELS * height // (source_height * source_width))
    for first in range(0, height, band):
        last = min(first + band, height)
        top, bottom = first * source_height // height, -(-last * source_height // height)
        wide: NDArray = pixels[top:bottom].astype(np.uint32 if whole else np.int64)
        if channels == 4:
            wide[..., :3] *= wide[..., 3:]
        if whole:
            sums = _block_sums(wide, last - first, width)
        else:
            rows = _interval_sums(wide, source_height, height, first, last, top)
            sums = _interval_sums(rows.swapaxes(0, 1), source_width, width, 0, width, 0).swapaxes(0, 1)
        if channels == 4:
            result[first:last, :, :3] = (sums[..., :3] + divisor * 255 // 2) // (divisor * 255)
            result[first:last, :, 3] = (sums[..., 3] + divisor // 2) // divisor
        else:
            result[first:last] = (sums + divisor // 2) // divisor
    return result


def straight_alpha(pixels: Bytes) -> Bytes:
    """Undo premultiplication, rounding to 8 bits: (H, W, 4) uint8 with colour at most alpha -> the same shape.

    The error of half a level shrinks by alpha / 255 when multiplied again, so premultiplying the result gives back
    the argument exactly. Transparent pixels become black.
    """
    alpha = pixels[..., 3:].astype(np.uint32)
    divisor = np.maximum(alpha, 1)
    straight = pixels.copy()
    straight[..., :3] = np.minimum((pixels[..., :3] * np.uint32(255) + divisor // 2) // divisor, 255)
    return straight


def _block_sums(values: NDArray, num_rows: int, num_columns: int) -> NDArray:
    """Sums over equal blocks, (H, W, C) -> (num_rows, num_columns, C); strided slices beat a reduction over axes."""
    for axis, number in ((0, num_rows), (1, num_columns)):
        step = values.shape[axis] // number
        slices = [values[i::step] if axis == 0 else values[:, i::step] for i in range(step)]
        values = slices[0] if step == 1 else slices[0] + slices[1]
        for other in slices[2:]:
            values += other
    return values


def _interval_sums(values: NDArray, n: int, m: int, first: int, last: int, offset: int) -> NDArray:
    """Integrals over [j n, (j + 1) n), j = first..last-1, of values that are constant on [i m, (i + 1) m).

    `values[0]` is value number `offset`. Exact: a difference of running integrals at whole positions.
    """
    running = np.zeros((len(values) + 1, *values.shape[1:]), values.dtype)
    np.cumsum(values, axis=0, out=running[1:])
    whole, part = np.divmod(np.arange(first, last + 1) * n - offset * m, m)
    inside = values[np.minimum(whole, len(values) - 1)]
    edges = running[whole] * m + inside * part.reshape(-1, *[1] * (values.ndim - 1))
    return edges[1:] - edges[:-1]


def _open(path: Path) -> ImageFile.ImageFile:
    """Open an image whose header promises something we decode; the file stays open until the image is closed."""
    try:
        # Opening a pipe would wait for ever.
        if not stat.S_ISREG(path.stat().st_mode):
            raise OSError("not a regular file")
        image = Image.open(path, formats=FORMATS)
    except FileNotFoundError:
        raise ValueError(f"{path}: image does not exist") from None
    except Image.UnidentifiedImageError:
        with path.open("rb") as file:
            said = what_else(file.read(HEAD), "convert it, or copy it again")
        raise ValueError(f"{path}: image must be a {' or '.join(FORMATS)} file; {said}") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ValueError(f"{path}: {_one_line(error)}") from error
    except (OSError, SyntaxError, ValueError, struct.error) as error:
        raise ValueError(f"{path}: image cannot be opened: {_one_line(error)}") from error
    width, height = image.size
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE:
        problem = f"at most {MAX_PIXELS} pixels and {MAX_SIDE} on a side, got {width} x {height}"
    elif image.mode not in MODES:
        problem = f"grey, palette, RGB or RGBA, got {image.mode}: convert it"
    else:
        return image
    image.close()
    raise ValueError(f"{path}: image must be {problem}")


def _decoded(image: ImageFile.ImageFile, path: Path, *, with_alpha: bool) -> Bytes:
    """Pixels (H, W, 4) uint8 with straight alpha, or (H, W, 3) if the file has none and none is wanted."""
    try:
        if "16B" in str(image.tile):
            return _rounded(_sixteen_bits(image, path), image.info.get("transparency"), with_alpha=with_alpha)
        mode = "RGBA" if with_alpha or image.has_transparency_data else "RGB"
        return np.asarray(image if image.mode == mode else image.convert(mode))
    # A decoder given hostile bytes raises many types (OSError, SyntaxError, zlib.error, struct.error, ...).
    except Exception as error:
        raise ValueError(f"{path}: image is truncated or broken: {_one_line(error)}") from error


def _sixteen_bits(image: ImageFile.ImageFile, path: Path) -> NDArray[np.uint16]:
    """Grey, grey with alpha, RGB or RGBA, (H, W, 1 to 4), of a PNG of 16 bits.

    Pillow keeps the upper eight of colour and alpha only, so that bytes are read one by one: those of grey with alpha
    as the four channels of a pixel, those of RGB and RGBA by reading the file twice, the lower ones as if they were the
    upper ones of numbers with the lower byte first.
    """
    codec, extents, offset, rawmode = image.tile[0]
    if image.mode == "I;16":
        return np.asarray(image)[..., None]
    if rawmode == "LA;16B":
        image.tile = [(codec, extents, offset, "RGBA")]  # type: ignore[list-item]
        parts = np.asarray(image).astype(np.uint16)
        return parts[..., 0::2] * np.uint16(256) + parts[..., 1::2]
    with _open(path) as again:
        again.tile = [(codec, extents, offset, f"{image.mode};16L")]  # type: ignore[list-item]
        lower = np.asarray(again).astype(np.uint16)
    return np.asarray(image).astype(np.uint16) * np.uint16(256) + lower


def _rounded(pixels: NDArray[np.uint16], transparent: object, *, with_alpha: bool) -> Bytes:
    """Pixels of 16 bits as colour of 8, with alpha if they have any, or one colour is transparent, or it is wanted."""
    color, alpha = (pixels[..., :-1], pixels[..., -1]) if pixels.shape[-1] % 2 == 0 else (pixels, None)
    if transparent is not None and alpha is None:
        alpha = np.where((color == np.asarray(transparent)).all(-1), np.uint16(0), np.uint16(65535))
    if alpha is None and with_alpha:
        alpha = np.full(color.shape[:2], 65535, np.uint16)
    parts = [np.broadcast_to(color, (*color.shape[:2], 3))] + ([] if alpha is None else [alpha[..., None]])
    # 65535 = 255 * 257
    return ((np.concatenate(parts, axis=-1).astype(np.uint32) + 128) // 257).astype(np.uint8)


def _orientation(image: Image.Image) -> int:
    """How an image is to be turned, 1 to 8 as in EXIF; 1, for not at all, where its header says nothing or nonsense."""
    # Without these a PNG would be decoded, to look behind its pixels.
    if "exif" not in image.info:
        return 1
    try:
        found = image.getexif().get(ORIENTATION, 1)
    except Exception:  # noqa: BLE001 (hostile bytes raise many types here, too)
        return 1
    return found if found in range(1, 9) else 1


def _turned(pixels: Bytes, orientation: int) -> Bytes:
    """Pixels (H, W, C) upright."""
    if orientation in TURNED:
        pixels = pixels.swapaxes(0, 1)
    # After that, columns are to be mirrored for 2, 3, 6 and 7, and rows for 3, 4, 7 and 8.
    columns, rows = orientation in (2, 3, 6, 7), orientation in (3, 4, 7, 8)
    return np.ascontiguousarray(pixels[:: -1 if rows else 1, :: -1 if columns else 1])


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
