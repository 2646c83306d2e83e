"""Frames of video files, decoded one after the other by ffmpeg: untrusted bytes in, pixels out."""

import re
import subprocess
from collections.abc import Generator, Iterator
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dnerf.data.images import MAX_PIXELS, MAX_SIDE, Bytes

# What the file names is not opened: playlists and the like could name other files and hosts.
CONTAINERS = "mov,matroska,webm,avi,mpeg,mpegts,mpegvideo,ogg,flv,asf,h264,hevc,m4v,ivf,gif,apng"
INPUT = ["-nostdin", "-protocol_whitelist", "file,pipe", "-format_whitelist", CONTAINERS]
OUTPUT = ["-map", "0:v:0", "-fps_mode", "passthrough"]  # each frame once, whatever its time


class VideoHeader(NamedTuple):
    """What a video holds."""

    width: int  # as it is shown: turned, where the file says so
    height: int
    fps: float  # 0 if the file does not say
    num_frames: int


def read_video_header(path: Path) -> VideoHeader:
    """Size, rate and number of frames of a video file; counting decodes it. ValueError as `read_frames`."""
    width, height, fps = _facts(path.resolve(), _stamp(path))
    run = _decoded_all(path, "-progress", "-")
    counts = [line[6:] for line in run.stdout.decode(errors="replace").splitlines() if line.startswith("frame=")]
    if run.returncode or not counts or not counts[-1].strip().isdigit() or int(counts[-1]) == 0:
        raise ValueError(f"{path}: video cannot be decoded: {_last_line(run.stderr.decode(errors='replace'))}")
    return VideoHeader(width, height, fps, int(counts[-1]))


def read_frame_times(path: Path) -> list[float]:
    """When each frame of a video file is shown, in seconds by the file's own clock: phones film at a changing rate.

    Raises ValueError as `read_frames`, or if the file states no times.
    """
    _facts(path.resolve(), _stamp(path))  # what is broken or too large is said in one way
    run = _decoded_all(path, "-vf", "showinfo=checksum=0")
    times = [float(time) for time in re.findall(rb" pts_time:(-?[0-9.]+(?:e[-+]?[0-9]+)?)", run.stderr)]
    if not times:
        last = _last_line(run.stderr.decode(errors="replace"))
        raise ValueError(f"{path}: video states no times of its frames: {last}")
    return times


def _decoded_all(path: Path, *options: str) -> subprocess.CompletedProcess[bytes]:
    """What ffmpeg says while it decodes a video and keeps nothing."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), *INPUT, "-i", f"file:{path.resolve()}", *OUTPUT, *options]
    return subprocess.run([*command, "-f", "null", "-"], capture_output=True, check=False)


def video_size(path: Path) -> tuple[int, int]:
    """Width and height of a video file's frames, without decoding them; ValueError as `read_frames`."""
    return _facts(path.resolve(), _stamp(path))[:2]


def read_frames(path: Path) -> Iterator[Bytes]:
    """All frames of a video file in order, (H, W, 3) uint8.

    Raises:
        ValueError: naming the file, if it is missing, not a video, larger than 2^25 pixels or 2^14 on a side, or
            broken.
    """
    _stamp(path)
    with closing(_decode(path)) as frames:
        width, height = next(frames)["size"]
        for frame in frames:
            yield np.frombuffer(frame, np.uint8).reshape(height, width, 3)


@lru_cache(maxsize=256)
def _facts(path: Path, stamp: tuple[int, int]) -> tuple[int, int, float]:
    """Width, height and rate; the stamp tells versions of a file apart."""
    with closing(_decode(path)) as frames:
        facts = next(frames)
    width, height = facts["size"]
    return width, height, float(facts["fps"])


def _decode(path: Path) -> Generator[Any, None, None]:
    """The facts of a video, then the bytes of each frame."""
    import imageio_ffmpeg

    frames = imageio_ffmpeg.read_frames(f"file:{path.resolve()}", input_params=INPUT, output_params=OUTPUT)
    try:
        facts = next(frames)
        width, height = facts["size"]
        if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE:
            raise ValueError(
                f"video must be at most {MAX_PIXELS} pixels and {MAX_SIDE} on a side, got {width} x {height}"
            )
        yield facts
        yield from frames
    # ffmpeg's messages, and what imageio-ffmpeg makes of hostile headers.
    except Exception as error:
        raise ValueError(f"{path}: video cannot be decoded: {_last_line(str(error))}") from error
    finally:
        frames.close()


def _stamp(path: Path) -> tuple[int, int]:
    """When a file was changed, and its size."""
    if not path.is_file():
        raise ValueError(f"{path}: video does not exist")
    status = path.stat()
    return status.st_mtime_ns, status.st_size


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return " ".join(lines[-1].split())[:200] if lines else "no reason given"
