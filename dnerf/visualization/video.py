"""Images to files: MP4, GIF and PNG frames; contact sheets."""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor, nn

from dnerf.core.checks import check_choice, check_positive
from dnerf.core.files import atomic_path, replaced_folder
from dnerf.visualization.colours import error_map

FORMATS = ("mp4", "gif", "png")
MAX_GIF_FPS = 50
MARGIN = 8  # white pixels between and around the images of a sheet
SHEET_COLUMNS = ("prediction", "truth", "error (yellow: 0.2 or more)")
# BT.709 in full, for ffmpeg: primaries, transfer and matrix.
COLORS = (
    # Without the matrix and its tags, players guess BT.601 or BT.709 by the image's size, and colours shift. The
    # encoder takes its tags from the frames, whose primaries and transfer the filter before leaves unknown.
    "-vf scale=out_color_matrix=bt709:out_range=tv,"
    "setparams=range=tv:color_primaries=bt709:color_trc=bt709:colorspace=bt709 "
    "-colorspace bt709 -color_primaries bt709 -color_trc bt709 -color_range tv"
)


def to_uint8(images: Tensor | NDArray) -> Tensor:
    """Round colours in [0, 1] to 8 bits, to the nearest; what lies outside is clamped and uint8 passes unchanged.

    Raises ValueError if a value is not finite, or the type is neither float nor uint8.
    """
    tensor = torch.as_tensor(images)
    if tensor.dtype == torch.uint8:
        return tensor
    if not tensor.is_floating_point():
        raise ValueError(f"images must be float or uint8, got {tensor.dtype}")
    if not bool(tensor.isfinite().all()):
        raise ValueError("images must be finite, got NaN or infinity")
    return (tensor.detach().float().clamp(0, 1) * 255).round().to(torch.uint8)


def write_frames(
    images: Iterable[Tensor | NDArray], path: str | Path, format: str | None = None, *, fps: float = 30.0,
    quality: float = 8.0,
) -> Path:  # fmt: skip
    """Write images as one MP4 or GIF, or as a folder of `frame_00000.png`, ...; returns the path.

    - mp4: H.264 in yuv420p, tagged as BT.709 (primaries, transfer, matrix), which every player shows. It needs even
      sizes: an odd one repeats its last row or column. Frames stream to the encoder; memory is that of one.
    - gif: loops for ever, 256 colours per frame. Its clock ticks in 1/100 s: frames last for a changing number of ticks
      (at 30 fps 3, 4, 3, ...) such that none begins more than half a tick off and the whole is right. Equal neighbours
      are merged. Compressed frames are held until the end.
    - png: frames stream to the folder; an existing folder is replaced if it holds nothing but such frames.

    The file appears when it is complete: a temporary one beside it is renamed, and removed upon any error.

    Args:
        images: (H, W, 3) each, float in [0, 1] or uint8, all of one size; may be a generator.
        path: the file or folder to write; missing parent folders are made.
        format: "mp4", "gif" or "png"; by the path's suffix if None ("png" if it has none).
        fps: frames per second, at most 50 for gif (players slow down what is faster).
        quality: of mp4, 0 to 10 (constant rate factor 51 to 0).

    Raises:
        ValueError: for an unknown format, no frames, frames that differ in size or are no images, an impossible fps or
            quality, a file name that ends otherwise, or a folder that holds other files.
    """
    path = Path(path)
    format = format or path.suffix[1:].lower() or "png"
    check_choice("format", format, FORMATS)
    check_fps(fps, format)
    if not 0 <= quality <= 10:
        raise ValueError(f"quality must be in [0, 10], got {quality}")
    frames = _checked(images)
    if format == "png":
        with replaced_folder(path, lambda name: name.startswith("frame_") and name.endswith(".png")) as folder:
            for index, frame in enumerate(frames):
                Image.fromarray(frame).save(folder / f"frame_{index:05d}.png")
        return path
    check_film(path, format)
    with atomic_path(path) as temporary:
        if format == "mp4":
            _write_mp4(frames, temporary, fps, quality)
        else:
            _write_gif(frames, temporary, fps)
    return path


def check_fps(fps: float, format: str) -> None:
    """Raise ValueError unless films of a format can show so many frames a second."""
    check_positive("fps", fps)
    if format == "gif" and fps > MAX_GIF_FPS:
        raise ValueError(f"fps must be at most {MAX_GIF_FPS} for gif, got {fps}")


def check_film(path: Path, format: str) -> None:
    """Raise ValueError unless a path may be that of a film in one file, by its name and as no folder is there."""
    if path.suffix.lower() != f".{format}" or path.is_dir():
        raise ValueError(f"path must be a file that ends in .{format}, got {path}")


def write_png(image: Tensor | NDArray, path: str | Path) -> Path:
    """Write one image (H, W, 3), float in [0, 1] or uint8; the file appears when it is complete."""
    pixels = next(_checked([image]))
    with atomic_path(Path(path)) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")
    return Path(path)


def contact_sheet(
    images: Sequence[Sequence[Tensor | NDArray]], columns: Sequence[str], rows: Sequence[str] = ()
) -> Tensor:
    """Lay images out as a table on white, with headings above and labels on the left: (height, width, 3) uint8.

    Args:
        images: rows of images (H, W, 3) of one size, float in [0, 1] or uint8, one per column; ValueError otherwise.
        columns: headings.
        rows: a label for each row, or none.
    """
    if not images or not columns or any(len(row) != len(columns) for row in images):
        raise ValueError(f"images must have rows of {len(columns)} > 0, got {[len(row) for row in images]}")
    if rows and len(rows) != len(images):
        raise ValueError(f"rows must be {len(images)} labels or none, got {len(rows)}")
    tiles = list(_checked(image for row in images for image in row))
    height, width = tiles[0].shape[:2]
    font = ImageFont.load_default(size=min(max(height / 18, 10), 28))
    line = math.ceil(max(font.getbbox(text)[3] for text in (*columns, *rows)))
    left = MARGIN + (math.ceil(max(font.getlength(text) for text in rows)) + MARGIN if rows else 0)
    # A heading wider than its image widens the column rather than run into the next.
    column_width = max(width, *(math.ceil(font.getlength(text)) for text in columns))
    row_height = max(height, line)
    top = line + 2 * MARGIN
    size = (left + len(columns) * (column_width + MARGIN), top + len(images) * (row_height + MARGIN))
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    for column, text in enumerate(columns):
        x = left + column * (column_width + MARGIN) + column_width / 2
        draw.text((x, MARGIN), text, fill="black", font=font, anchor="ma")
    for row, text in enumerate(rows):
        y = top + row * (row_height + MARGIN) + row_height / 2
        draw.text((MARGIN, y), text, fill="black", font=font, anchor="lm")
    for index, tile in enumerate(tiles):
        row, column = divmod(index, len(columns))
        x = left + column * (column_width + MARGIN) + (column_width - width) // 2
        y = top + row * (row_height + MARGIN) + (row_height - height) // 2
        draw.rectangle((x - 1, y - 1, x + width, y + height), outline="lightgrey")
        sheet.paste(Image.fromarray(tile), (x, y))
    return torch.from_numpy(np.array(sheet))


def comparison_sheet(pairs: Sequence[tuple[Tensor, Tensor]], rows: Sequence[str] = ()) -> Tensor:
    """A contact sheet of predictions and truths, (H, W, 3) in [0, 1], and errors, with labels of its rows.

    Pairs of different sizes are filled up with white.
    """
    height, width = (max((truth.shape[axis] for _, truth in pairs), default=0) for axis in (0, 1))

    def filled(tile: Tensor) -> Tensor:
        return nn.functional.pad(tile, (0, 0, 0, width - tile.shape[1], 0, height - tile.shape[0]), value=1.0)

    tiles = [[prediction, truth, error_map(prediction, truth)] for prediction, truth in pairs]
    return contact_sheet([[filled(tile) for tile in row] for row in tiles], SHEET_COLUMNS, rows)


def _checked(images: Iterable[Tensor | NDArray]) -> Iterator[NDArray[np.uint8]]:
    """Check and round each image as it comes, (H, W, 3) uint8 in memory order."""
    shape = None
    for index, image in enumerate(images):
        pixels = np.ascontiguousarray(to_uint8(image).cpu().numpy())
        if pixels.ndim != 3 or pixels.shape[-1] != 3 or not pixels.size:
            raise ValueError(f"images[{index}] must have shape (H, W, 3), got {pixels.shape}")
        shape = shape or pixels.shape
        if pixels.shape != shape:
            raise ValueError(f"images[{index}] must have shape {shape} as the first, got {pixels.shape}")
        yield pixels
    if shape is None:
        raise ValueError("images must hold at least one frame, got none")


def _write_mp4(frames: Iterator[NDArray[np.uint8]], path: Path, fps: float, quality: float) -> None:
    import imageio.v2 as imageio
    import imageio_ffmpeg

    first = next(frames)
    padding = ((0, first.shape[0] % 2), (0, first.shape[1] % 2), (0, 0))
    writer: Any = imageio.get_writer(
        path, format="FFMPEG", mode="I", fps=fps, codec="libx264", quality=quality, pixelformat="yuv420p",
        macro_block_size=1, ffmpeg_log_level="error", output_params=[*COLORS.split(), "-movflags", "+faststart"],
    )  # fmt: skip
    num_frames = 0
    # As a context manager the writer would leave the encoder running after an error.
    with closing(writer):
        for frame in itertools.chain([first], frames):
            writer.append_data(np.pad(frame, padding, mode="edge"))
            num_frames += 1
    # The encoder's exit status is not looked at by imageio: a full disk would pass for success.
    try:
        num_found, _ = imageio_ffmpeg.count_frames_and_secs(path)
    except RuntimeError as error:
        raise OSError(f"{path}: ffmpeg could not complete the video") from error
    if num_found != num_frames:
        raise OSError(f"{path}: ffmpeg wrote {num_found} of {num_frames} frames")


def _write_gif(frames: Iterator[NDArray[np.uint8]], path: Path, fps: float) -> None:
    images = [Image.fromarray(frame).quantize(256) for frame in frames]
    ticks = [math.floor(100 * index / fps + 0.5) for index in range(len(images) + 1)]
    durations = [10 * (after - before) for before, after in itertools.pairwise(ticks)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0)
