"""The frames that a data set is made of: the sharpest of each stretch of a film, or all images of a folder."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from dnerf.core.files import atomic_path
from dnerf.data.formats.folder import IMAGE_SUFFIXES, VIDEO_SUFFIXES, frame_numbers, is_seen
from dnerf.data.images import Bytes, read_header, read_image
from dnerf.data.videos import read_frame_times, read_frames

CODECS = "convert it with: ffmpeg -i {} -c:v libx264 -pix_fmt yuv420p film.mp4"


@dataclass(frozen=True)
class ChosenFrame:
    """One frame of a data set."""

    name: str  # of its image, below the folder of images
    time: float  # seconds of its film, or the number in its name
    film: int  # index of its camera
    size: tuple[int, int]  # width and height


@dataclass(frozen=True)
class Film:
    """Frames of one camera in order: a video file, or images."""

    name: str  # a folder for its images, or none
    path: Path
    images: tuple[Path, ...] = ()  # those of a folder; none for a video
    is_ordered: bool = True  # whether the next frame shows about the same

    def times(self) -> list[float]:
        """Of each frame, from 0."""
        if not self.images:
            times = read_frame_times(self.path)
            return [time - times[0] for time in times]
        return frame_numbers(_stems(self.path, self.images)) or [float(index) for index in range(len(self.images))]

    def pixels(self) -> Iterator[Bytes]:
        """Each frame upright, (H, W, 3) uint8."""
        if not self.images:
            yield from read_frames(self.path)
        for path in self.images:
            width, height, _ = read_header(path)
            yield read_image(path, width=width, height=height, channels=3, size=(width, height))

    def label(self, index: int) -> str:
        """A frame's name below the folder of images."""
        if self.images:
            return self.images[index].relative_to(self.path).with_suffix(".png").as_posix()
        return f"{self.name}/{index:05d}.png" if self.name else f"{index:05d}.png"


def find_films(video: Path | None = None, images: Path | None = None) -> list[Film]:
    """The film of a video file, those of a folder of videos, one for each camera, or the images of a folder by name.

    Raises:
        ValueError: naming the path, if nothing is there, a file is empty, or both or neither are given.
    """
    if (video is None) == (images is None):
        raise ValueError("give video=film.mp4, or a folder of videos, or images=folder, and one of them only")
    if images is not None:
        return [_film_of_images(images)]
    assert video is not None
    if not video.exists():
        raise ValueError(f"video: {video} does not exist; give a video file, or a folder of one for each camera")
    files = [video]
    if video.is_dir():
        files = sorted(file for file in video.iterdir() if is_seen(file, VIDEO_SUFFIXES))
        if not files or len({file.stem for file in files}) < len(files):
            raise ValueError(f"video: {video} must hold videos of different names; if it holds images, images={video}")
    for file in files:
        if file.stat().st_size == 0:
            raise ValueError(f"video: {file} is empty, of 0 bytes; copy it again from the phone")
    return [Film(file.stem if video.is_dir() else "", file) for file in files]


def _film_of_images(folder: Path) -> Film:
    paths = sorted(path for path in folder.rglob("*") if is_seen(path, IMAGE_SUFFIXES) and path.is_file())
    names = _stems(folder, paths)
    if len(paths) < 2 or len(set(names)) < len(paths):
        raise ValueError(f"images: {folder} must hold PNG or JPEG images of different names, got {len(paths)}")
    numbers = frame_numbers(names)
    paths = paths if numbers is None else [path for _, path in sorted(zip(numbers, paths))]
    return Film("", folder, tuple(paths), is_ordered=numbers is not None)


def _stems(folder: Path, paths: Sequence[Path]) -> list[str]:
    return [path.relative_to(folder).with_suffix("").as_posix() for path in paths]


def choose_frames(films: Sequence[Film], folder: Path, num_frames: int | None, width: int) -> list[ChosenFrame]:
    """Write the sharpest frame of each of `num_frames` equal stretches of each film, reduced to a width at most.

    Args:
        folder: where images go, as PNG.
        num_frames: of each film; None for all.

    Raises:
        ValueError: naming the file, if it cannot be decoded.
    """
    chosen: list[ChosenFrame] = []
    for number, film in enumerate(films):
        try:
            chosen += _choose(film, number, folder, num_frames, width)
        except ValueError as error:
            if film.images:
                raise
            raise ValueError(f"{error}; {CODECS.format(film.path.name)}") from error
    return chosen


def _choose(film: Film, number: int, folder: Path, num_frames: int | None, width: int) -> Iterator[ChosenFrame]:
    times = film.times()
    count = min(num_frames or len(times), len(times))
    best: tuple[float, int, Bytes] | None = None
    bar = tqdm(film.pixels(), f"frames of {film.path.name}", total=len(times), unit="frame")
    for index, pixels in zip(range(len(times)), bar):
        small = _reduced(pixels, width)
        found = sharpness(small)
        if best is None or found > best[0]:
            best = (found, index, small)
        if (index + 1) * count // len(times) > index * count // len(times):
            _, place, image = best
            name = film.label(place)
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(folder / name) as temporary:
                Image.fromarray(image).save(temporary, compress_level=1)
            yield ChosenFrame(name, times[place], number, (image.shape[1], image.shape[0]))
            best = None


def _reduced(pixels: Bytes, width: int) -> Bytes:
    """The image with a longer side of at most `width`, averaged over pixel areas."""
    scale = width / max(pixels.shape[:2])
    if scale >= 1:
        return pixels
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))


def sharpness(pixels: Bytes) -> float:
    """Variance of the Laplacian of an image's brightness (H, W, 3), 0 for one of less than 3 pixels on a side.

    Source: Pech-Pacheco et al. 2000, "Diatom autofocusing in brightfield microscopy".
    """
    grey = pixels.astype(np.float32).mean(-1)
    middle = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * middle
    return float(laplacian.var()) if laplacian.size else 0.0
