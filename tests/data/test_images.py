import io
import os
import struct
import zlib
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dnerf.data.images import premultiplied_area_average, read_header, read_image, straight_alpha


def loop_area_average(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """The definition, in exact fractions: mean over the overlap of pixel squares, one rounding (half up)."""

    def overlap(source: int, target: int, n: int, m: int) -> Fraction:
        low = max(Fraction(source), Fraction(target * n, m))
        high = min(Fraction(source + 1), Fraction((target + 1) * n, m))
        return max(high - low, Fraction(0))

    source_height, source_width, channels = pixels.shape
    result = np.empty((height, width, channels), np.uint8)
    area = Fraction(source_height * source_width, height * width)
    for y, x, c in np.ndindex(height, width, channels):
        total = Fraction(0)
        for j, i in np.ndindex(source_height, source_width):
            weight = overlap(j, y, source_height, height) * overlap(i, x, source_width, width)
            alpha = Fraction(int(pixels[j, i, 3]), 255) if channels == 4 and c < 3 else 1
            total += weight * int(pixels[j, i, c]) * alpha
        result[y, x, c] = int(total / area + Fraction(1, 2))
    return result


@given(
    source=st.tuples(st.integers(1, 7), st.integers(1, 7)),
    data=st.data(),
    channels=st.sampled_from([3, 4]),
    seed=st.integers(0, 2**32 - 1),
)
def test_area_average_is_the_exact_mean_over_pixel_areas(
    source: tuple[int, int], data: st.DataObject, channels: int, seed: int
) -> None:
    height = data.draw(st.integers(1, source[0]))
    width = data.draw(st.integers(1, source[1]))
    pixels = np.random.default_rng(seed).integers(0, 256, (*source, channels), dtype=np.uint8)
    averaged = premultiplied_area_average(pixels, width, height)
    np.testing.assert_array_equal(averaged, loop_area_average(pixels, width, height))


@pytest.mark.parametrize("size", [(400, 300), (250, 250), (777, 600), (1, 1), (800, 600)])
def test_bands_of_a_large_image_leave_no_seams(size: tuple[int, int]) -> None:
    """A linear ramp averages to the linear ramp; a wrong offset of one band would show as a jump."""
    width, height = size
    ramp = np.linspace(0, 255, 600)[:, None, None] + np.zeros((600, 800, 3))
    averaged = premultiplied_area_average(np.rint(ramp).astype(np.uint8), width, height).astype(float)
    centers = (np.arange(height) + 0.5) * 600 / height - 0.5
    # half a level of the source and half of the result
    assert np.abs(averaged - (centers * 255 / 599)[:, None, None]).max() <= 1.0


def test_largest_values_do_not_overflow_and_colour_never_exceeds_alpha() -> None:
    white = np.full((600, 601, 4), 255, np.uint8)
    for size in [(1, 1), (7, 11), (601, 1), (1, 600)]:
        assert (premultiplied_area_average(white, *size) == 255).all()
    pixels = np.random.default_rng(0).integers(0, 256, (60, 70, 4), dtype=np.uint8)
    pixels[..., 0] = 255
    for size in [(70, 60), (35, 30), (33, 17)]:
        averaged = premultiplied_area_average(pixels, *size)
        assert (averaged[..., :3] <= averaged[..., 3:]).all()
        assert (averaged[..., 0] == averaged[..., 3]).all()  # white is its alpha exactly


@pytest.mark.parametrize("size", [(0, 1), (1, 0), (5, 4), (4, 5)])
def test_enlarging_or_emptying_is_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="width and height must be in"):
        premultiplied_area_average(np.zeros((4, 4, 3), np.uint8), *size)


def test_straight_alpha_is_undone_exactly_by_premultiplying_and_clamps_colour_above_alpha() -> None:
    """All pairs of colour <= alpha."""
    alpha, color = np.meshgrid(np.arange(256), np.arange(256), indexing="ij")
    valid = color <= alpha
    pixels = np.stack([color, np.zeros_like(color), alpha, alpha], axis=-1)[valid][None].astype(np.uint8)
    again = premultiplied_area_average(straight_alpha(pixels), pixels.shape[1], 1)
    np.testing.assert_array_equal(again, pixels)
    above = np.array([[[101, 100, 0, 100], [1, 0, 0, 0]]], np.uint8)
    np.testing.assert_array_equal(straight_alpha(above), [[[255, 255, 0, 100], [255, 0, 0, 0]]])


def save(image: Image.Image, path: Path, **options: object) -> Path:
    image.save(path, **options)
    return path


def read(path: Path, channels: int = 4) -> np.ndarray:
    return read_image(path, width=4, height=3, channels=channels, size=(4, 3))


@pytest.mark.parametrize(("mode", "has_alpha"), [("RGB", False), ("RGBA", True), ("L", False), ("LA", True)])
def test_grey_and_colour_are_expanded(tmp_path: Path, mode: str, has_alpha: bool) -> None:
    values = np.random.default_rng(0).integers(0, 256, (3, 4, 4), dtype=np.uint8)
    image = Image.fromarray(values).convert(mode)
    path = save(image, tmp_path / "a.png")
    assert read_header(path) == (4, 3, has_alpha)
    if not has_alpha:
        np.testing.assert_array_equal(read(path, 3), np.asarray(image.convert("RGB")))
        assert (read(path)[..., 3] == 255).all()
    expected = loop_area_average(np.asarray(image.convert("RGBA")), 4, 3)
    np.testing.assert_array_equal(read(path), expected)


def test_palettes_are_expanded_with_their_transparency_and_jpeg_is_read(tmp_path: Path) -> None:
    image = Image.new("P", (4, 3), 1)
    image.putpalette([10, 20, 30, 200, 100, 50])
    opaque = save(image, tmp_path / "opaque.png")
    assert read_header(opaque) == (4, 3, False)
    assert (read(opaque, 3) == [200, 100, 50]).all()
    transparent = save(image, tmp_path / "transparent.png", transparency=1)
    assert read_header(transparent) == (4, 3, True)
    assert (read(transparent) == 0).all()
    path = save(Image.new("RGB", (4, 3), (200, 100, 50)), tmp_path / "a.jpg", quality=100)
    assert read_header(path) == (4, 3, False)
    assert np.abs(read(path, 3).astype(int) - [200, 100, 50]).max() <= 2  # JPEG's own rounding


def png(width: int, height: int, depth: int = 8, color_type: int = 6, data: bytes = b"") -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (png(30_000, 30_000), "30000 x 30000|exceeds limit"),
        (png(100_000, 1), "at most 33554432 pixels and 16384 on a side, got 100000 x 1"),
        (png(8000, 8000), "at most 33554432 pixels and 16384 on a side, got 8000 x 8000"),
        (png(0, 0), "image"),
        (png(4, 3, depth=16), "image must be of 8 bits per channel, got 16"),
        (png(4, 3, depth=16, color_type=0), "image must be of 8 bits per channel, got 16"),
        (b"", "image must be a PNG or JPEG file"),
        (b"\x89PNG\r\n\x1a\n", "image"),
        (b"not an image at all, although it is long enough", "image must be a PNG or JPEG file"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 3\n", "image must be a PNG or JPEG file"),
        (b"GIF89a\x04\x00\x03\x00\x00\x00\x00", "image must be a PNG or JPEG file"),
    ],
)
def test_what_is_no_sensible_image_is_refused_by_its_header(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_header(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_palette_image_without_a_palette_is_refused(tmp_path: Path) -> None:
    """Found by fuzzing: an AssertionError of Pillow's."""
    path = tmp_path / "image.png"
    Image.new("P", (4, 4)).save(path)
    data = path.read_bytes()
    begin = data.index(b"PLTE") - 4
    length = int.from_bytes(data[begin : begin + 4], "big")
    path.write_bytes(data[:begin] + data[begin + 12 + length :])
    with pytest.raises(ValueError, match=r"image\.png: image has colours of a palette, but no palette"):
        read_header(path)


def test_cmyk_and_another_size_than_promised_are_refused(tmp_path: Path) -> None:
    path = save(Image.new("CMYK", (4, 3)), tmp_path / "a.jpg")
    with pytest.raises(ValueError, match="image must be grey, palette, RGB or RGBA, got CMYK"):
        read_header(path)
    path = save(Image.new("RGB", (4, 3)), tmp_path / "a.png")
    with pytest.raises(ValueError, match="image must be 5 x 3, got 4 x 3"):
        read_image(path, width=4, height=3, channels=3, size=(5, 3))


def test_every_truncation_is_an_error_or_the_whole_picture(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    values = np.random.default_rng(0).integers(0, 256, (3, 4, 4), dtype=np.uint8)
    Image.fromarray(values).save(buffer, "PNG")
    whole, path = buffer.getvalue(), tmp_path / "a.png"
    path.write_bytes(whole)
    expected = read(path)
    refused = 0
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        try:
            np.testing.assert_array_equal(read(path), expected)
        except ValueError as error:
            assert str(path) in str(error)  # noqa: PT017 - which of the two happens depends on the byte
            refused += 1
    # only the checksums and the end mark after the pixels may be lacking
    assert refused >= len(whole) - 30


@pytest.mark.parametrize("start", [8, 16, 29, 41, 60])
def test_broken_bytes_raise_nothing_but_value_error(tmp_path: Path, start: int) -> None:
    buffer = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (3, 4, 4), dtype=np.uint8)).save(buffer, "PNG")
    path = tmp_path / "a.png"
    for value in range(0, 256, 5):
        content = bytearray(buffer.getvalue())
        content[start : start + 3] = bytes([value] * 3)
        path.write_bytes(content)
        try:
            read(path)
        except ValueError as error:
            assert str(path) in str(error)  # noqa: PT017 - some changes leave a valid picture


def test_missing_file_folder_and_pipe_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="image does not exist"):
        read_header(tmp_path / "none.png")
    with pytest.raises(ValueError, match="not a regular file"):
        read_header(tmp_path)
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(ValueError, match="not a regular file"):
        read_header(tmp_path / "pipe.png")
