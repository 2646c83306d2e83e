import io
import os
import struct
import zlib
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps

from dnerf.data.images import (
    check_image,
    premultiplied_area_average,
    read_header,
    read_image,
    read_mask,
    straight_alpha,
)


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


def filtered(rows: np.ndarray, chance: np.random.Generator) -> bytes:
    """Rows (H, W, B) uint8 of pixels of B bytes, each with one of the filters none, sub, up and average."""
    rows, above, result = rows.astype(int), np.zeros(rows.shape[1:], int), b""
    for row in rows:
        kind = int(chance.integers(4))
        left = np.concatenate([np.zeros((1, row.shape[1]), int), row[:-1]])
        guess = (0 * row, left, above, (left + above) // 2)[kind]
        result += bytes([kind]) + ((row - guess) % 256).astype(np.uint8).tobytes()
        above = row
    return zlib.compress(result)


@pytest.mark.parametrize(("color_type", "channels"), [(0, 1), (2, 3), (4, 2), (6, 4)])
@pytest.mark.parametrize("transparent", [False, True])
def test_sixteen_bits_are_rounded_to_eight(tmp_path: Path, color_type: int, channels: int, transparent: bool) -> None:
    chance = np.random.default_rng(color_type)
    values = chance.integers(0, 65536, (3, 4, channels))
    values[0, 0] = 128  # rounded down from half a level; its upper byte is 0
    values[0, 1] = 129  # rounded up
    content = png(4, 3, 16, color_type, filtered(values.astype(">u2").view(np.uint8).reshape(3, 4, -1), chance))
    has_alpha = channels in (2, 4)
    if transparent and not has_alpha:
        kept = content.index(b"IDAT") - 4
        color = values[1, 2].astype(">u2").tobytes()
        chunk = struct.pack(">I", len(color)) + b"tRNS" + color + struct.pack(">I", zlib.crc32(b"tRNS" + color))
        content = content[:kept] + chunk + content[kept:]
    path = tmp_path / "a.png"
    path.write_bytes(content)
    colors = values[..., :-1] if has_alpha else values
    alpha = values[..., -1] if has_alpha else np.full((3, 4), 65535)
    if transparent and not has_alpha:
        alpha[1, 2] = 0
    assert read_header(path) == (4, 3, has_alpha or transparent)
    straight = np.concatenate([np.broadcast_to(colors, (3, 4, 3)), alpha[..., None]], -1)
    eight = np.array([[[int(Fraction(int(v), 257) + Fraction(1, 2)) for v in p] for p in row] for row in straight])
    np.testing.assert_array_equal(read(path), loop_area_average(eight.astype(np.uint8), 4, 3))
    if not has_alpha and not transparent:
        np.testing.assert_array_equal(read(path, 3), eight[..., :3])


@pytest.mark.parametrize("kind", ["png", "jpg"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_turned_as_their_exif_data_say(tmp_path: Path, kind: str, orientation: int) -> None:
    values = np.random.default_rng(0).integers(0, 256, (32, 48, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = save(Image.fromarray(values), tmp_path / f"a.{kind}", exif=exif)
    with Image.open(path) as image:
        stored, upright = np.asarray(image), np.asarray(ImageOps.exif_transpose(image))
    height, width = upright.shape[:2]
    assert read_header(path)[:2] == (width, height)
    assert read_header(path, upright=False)[:2] == (48, 32)
    turned = read_image(path, width=width, height=height, channels=3, size=(width, height))
    np.testing.assert_array_equal(turned, upright)
    kept = read_image(path, width=48, height=32, channels=3, size=(48, 32), upright=False)
    np.testing.assert_array_equal(kept, stored)


@pytest.mark.parametrize(
    "exif", [b"", b"Exif\0\0", b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x02\0\0\0\x04abcd", b"\xff" * 40]
)
@pytest.mark.filterwarnings("ignore:Corrupt EXIF data")
def test_broken_exif_data_turn_nothing(tmp_path: Path, exif: bytes) -> None:
    path = save(Image.new("RGB", (4, 3)), tmp_path / "a.jpg", exif=exif)
    assert read_header(path) == (4, 3, False)
    assert read(path, 3).shape == (3, 4, 3)


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_masks_become_alpha(tmp_path: Path, mode: str) -> None:
    chance = np.random.default_rng(1)
    values = chance.integers(0, 256, (3, 4, len(mode)), dtype=np.uint8)
    image = save(Image.fromarray(values), tmp_path / "a.png")
    levels = chance.integers(0, 256, (3, 4), dtype=np.uint8)
    mask = save(Image.fromarray(levels), tmp_path / "mask.png")
    alpha = values[..., 3].astype(int) if mode == "RGBA" else 255
    expected = np.concatenate(
        [values[..., :3], np.rint(alpha * levels.astype(int) / 255)[..., None].astype(np.uint8)], -1
    )
    read_masked = partial(read_image, image, width=4, height=3, size=(4, 3), mask=mask)
    np.testing.assert_array_equal(read_masked(channels=4), loop_area_average(expected, 4, 3))
    with pytest.raises(ValueError, match=r"mask\.png: image must be opaque"):
        read_masked(channels=3)
    save(Image.new("1", (4, 3), 1), mask)
    np.testing.assert_array_equal(read_masked(channels=4), read(image))


def test_masks_are_averaged_to_their_images_and_of_other_shapes_refused(tmp_path: Path) -> None:
    levels = np.random.default_rng(2).integers(0, 256, (6, 8), dtype=np.uint8)
    path = save(Image.fromarray(levels), tmp_path / "mask.png")
    expected = loop_area_average(np.repeat(levels[..., None], 3, -1), 4, 3)[..., 0]
    np.testing.assert_array_equal(read_mask(path, (4, 3)), expected)
    for size in [(16, 12), (8, 40)]:
        with pytest.raises(ValueError, match=r"mask\.png: mask must be .* as its image, .* got 8 x 6"):
            read_mask(path, size)
    colored = save(Image.fromarray(np.array([[[0, 200, 0, 255], [255, 255, 255, 51]]], np.uint8)), tmp_path / "b.png")
    assert read_mask(colored, (2, 1)).tolist() == [[200, 51]]


@pytest.mark.parametrize(("content", "message"), [
    (png(30_000, 30_000), "30000 x 30000|exceeds limit"),
    (png(100_000, 1), "at most 33554432 pixels and 16384 on a side, got 100000 x 1"),
    (png(8000, 8000), "at most 33554432 pixels and 16384 on a side, got 8000 x 8000"),
    (png(0, 0), "image"),
    (b"", "image must be a PNG or JPEG file; it is empty: copy or export it again"),
    (b"<!DOCTYPE html>", "image must be a PNG or JPEG file; it is a web page"),
    (b"\0\0\0\x18ftypheic", "image must be a PNG or JPEG file; it is HEIC"),
    (b"\x89PNG\r\n\x1a\n", "image"),
    (b"not an image at all, although it is long enough", "image must be a PNG or JPEG file"),
    (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 3\n", "image must be a PNG or JPEG file"),
    (b"GIF89a\x04\x00\x03\x00\x00\x00\x00", "image must be a PNG or JPEG file"),
])  # fmt: skip
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
    with pytest.raises(ValueError, match="image must be grey, palette, RGB or RGBA, got CMYK: convert it"):
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


@pytest.mark.parametrize(("kind", "step"), [("PNG", 1), ("JPEG", 9)])
def test_a_file_that_ends_early_is_found_as_when_it_is_read(tmp_path: Path, kind: str, step: int) -> None:
    def fails(what: Callable[[Path], object]) -> bool:
        try:
            what(path)
        except ValueError as error:
            assert str(path) in str(error)  # noqa: PT017 - which of the two happens depends on the byte
            return True
        return False

    buffer, path = io.BytesIO(), tmp_path / "a.png"
    values = np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8)
    Image.fromarray(values).save(buffer, kind)
    found = []
    for length in [*range(0, len(buffer.getvalue()), step), len(buffer.getvalue())]:
        path.write_bytes(buffer.getvalue()[:length])
        found.append(fails(check_image))
        assert found[-1] == fails(partial(read_image, width=16, height=16, channels=3, size=(16, 16)))
    assert sum(found) > 0.9 * len(found)
    assert not found[-1]


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
