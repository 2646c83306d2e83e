"""Image files to premultiplied uint8 pixels of a chosen size: untrusted bytes in, exact area averages out."""

import stat
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

MAX_PIXELS = 2**25
MAX_SIDE = 2**14
FORMATS = ("PNG", "JPEG")
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")
BAND_PIXELS = 2**15

Bytes = NDArray[np.uint8]


def read_header(path: Path) -> tuple[int, int, bool]:
    """Width, height and whether an image file has alpha, without decoding it.

    Raises ValueError naming the file, if it is missing, not a PNG or JPEG with 8 bits per channel, or larger than 2^25
    pixels or 2^14 on a side.
    """
    with _open(path) as image:
        try:
            return image.width, image.height, image.has_transparency_data
        except AssertionError as error:
            raise ValueError(f"{path}: image has colours of a palette, but no palette") from error


def read_image(path: Path, *, width: int, height: int, channels: int, size: tuple[int, int]) -> Bytes:
    """Decode an image, premultiply by alpha, average over pixel areas and round once: (height, width, channels) uint8.

    Palettes and grey are expanded to colour.

    Args:
        path: a PNG or JPEG file of `size`, (width, height).
        width: columns of the result, at most the file's.
        height: rows of the result, at most the file's.
        channels: 4 for premultiplied colour and alpha, 3 for an image that is opaque everywhere.

    Raises:
        ValueError: naming the file, as `read_header`, or if it is truncated, of another size, or transparent somewhere
            where `channels` is 3.
    """
    with _open(path) as image:
        if image.size != size:
            raise ValueError(f"{path}: image must be {size[0]} x {size[1]}, got {image.width} x {image.height}")
        pixels = _decoded(image, path, with_alpha=channels == 4)
    if pixels.shape[-1] > channels:
        if pixels[..., 3].min() < 255:
            raise ValueError(f"{path}: image must be opaque, as the training images are, got transparent pixels")
        pixels = pixels[..., :channels]
    return premultiplied_area_average(pixels, width, height)


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


def _open(path: Path) -> Image.Image:
    """Open an image whose header promises something we decode; the file stays open until the image is closed."""
    try:
        # Opening a pipe would wait for ever.
        if not stat.S_ISREG(path.stat().st_mode):
            raise OSError("not a regular file")
        with path.open("rb") as file:
            head = file.read(25)
        image = Image.open(path, formats=FORMATS)
    except FileNotFoundError:
        raise ValueError(f"{path}: image does not exist") from None
    except Image.UnidentifiedImageError:
        raise ValueError(f"{path}: image must be a {' or '.join(FORMATS)} file") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ValueError(f"{path}: {_one_line(error)}") from error
    except (OSError, SyntaxError, ValueError, struct.error) as error:
        raise ValueError(f"{path}: image cannot be opened: {_one_line(error)}") from error
    width, height = image.size
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE:
        problem = f"at most {MAX_PIXELS} pixels and {MAX_SIDE} on a side, got {width} x {height}"
    # Pillow would cut 16 bits to 8 without a word.
    elif head.startswith(b"\x89PNG") and head[24] > 8:
        problem = f"of 8 bits per channel, got {head[24]}"
    elif image.mode not in MODES:
        problem = f"grey, palette, RGB or RGBA, got {image.mode}"
    else:
        return image
    image.close()
    raise ValueError(f"{path}: image must be {problem}")


def _decoded(image: Image.Image, path: Path, *, with_alpha: bool) -> Bytes:
    """Pixels (H, W, 4) uint8 with straight alpha, or (H, W, 3) if the file has none and none is wanted."""
    try:
        mode = "RGBA" if with_alpha or image.has_transparency_data else "RGB"
        return np.asarray(image if image.mode == mode else image.convert(mode))
    # A decoder given hostile bytes raises many types (OSError, SyntaxError, zlib.error, struct.error, ...).
    except Exception as error:
        raise ValueError(f"{path}: image is truncated or broken: {_one_line(error)}") from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
