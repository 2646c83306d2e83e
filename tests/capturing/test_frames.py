"""Which frames of a film, or images of a folder, a data set is made of."""

import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image, ImageFilter

from dnerf.capturing.frames import choose_frames, find_films, sharpness
from dnerf.data.videos import read_frame_times
from dnerf.visualization import write_frames


def noise(seed: int, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    """A colourful image that blurring changes much."""
    coarse = np.random.default_rng(seed).integers(0, 256, (size[0] // 4, size[1] // 4, 3), dtype=np.uint8)
    return coarse.repeat(4, 0).repeat(4, 1)


def blurred(pixels: np.ndarray, radius: float) -> np.ndarray:
    return np.array(Image.fromarray(pixels).filter(ImageFilter.GaussianBlur(radius)))


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def names_and_times(folder: Path, num_frames: int | None = None, width: int = 64, **sources: Path) -> list:
    return [(f.name, f.time) for f in choose_frames(find_films(**sources), folder, num_frames, width)]


def test_sharpness_is_the_variance_of_a_brute_force_laplacian() -> None:
    pixels = noise(0, (8, 12))
    grey = pixels.astype(np.float64).mean(-1)
    values = [
        grey[r - 1, c] + grey[r + 1, c] + grey[r, c - 1] + grey[r, c + 1] - 4 * grey[r, c]
        for r in range(1, 7)
        for c in range(1, 11)
    ]
    assert sharpness(pixels) == pytest.approx(np.var(values), rel=1e-5)  # float32
    assert sharpness(blurred(pixels, 1)) < sharpness(pixels)
    assert sharpness(pixels[:2]) == 0


def test_the_sharpest_frame_of_each_stretch_is_kept_with_its_time(tmp_path: Path) -> None:
    sharp = {2, 3, 7, 11}  # one of each stretch of three
    frames = [noise(i) if i in sharp else blurred(noise(i), 2.5) for i in range(12)]
    write_frames(frames, tmp_path / "film.mp4", fps=10)
    found = names_and_times(tmp_path / "images", 4, video=tmp_path / "film.mp4")
    assert found == [(f"{i:05d}.png", pytest.approx(i / 10)) for i in sorted(sharp)]
    assert {path.name for path in (tmp_path / "images").iterdir()} == {name for name, _ in found}


def test_more_frames_than_there_are_takes_all(tmp_path: Path) -> None:
    write_frames([noise(i) for i in range(5)], tmp_path / "film.mp4", fps=10)
    assert len(names_and_times(tmp_path / "images", 100, video=tmp_path / "film.mp4")) == 5


def test_times_are_those_of_a_film_whose_rate_changes(tmp_path: Path) -> None:
    write_frames([noise(i) for i in range(6)], tmp_path / "even.mp4", fps=10)
    slower = ["-vf", "setpts=N*N*0.1/TB", "-fps_mode", "vfr", "-video_track_timescale", "1000"]
    source = ["-i", str(tmp_path / "even.mp4")]
    subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *source, *slower, str(tmp_path / "film.mp4")], check=True
    )
    times = np.array(read_frame_times(tmp_path / "film.mp4"))
    # The file's clock ticks in milliseconds.
    np.testing.assert_allclose(times - times[0], 0.1 * np.arange(6) ** 2, atol=2e-3)


def test_videos_of_a_folder_are_cameras_with_folders_of_their_own(tmp_path: Path) -> None:
    for name in ("left", "right"):
        write_frames([noise(i) for i in range(4)], tmp_path / "films" / f"{name}.mp4", fps=2)
    frames = choose_frames(find_films(tmp_path / "films"), tmp_path / "images", 2, 64)
    assert [frame.film for frame in frames] == [0, 0, 1, 1]
    assert {frame.name.split("/")[0] for frame in frames} == {"left", "right"}


def test_images_are_ordered_and_timed_by_their_numbers(tmp_path: Path) -> None:
    for number in (10, 9, 2):
        save(tmp_path / "photos" / f"img_{number}.png", noise(number))
    (film,) = find_films(images=tmp_path / "photos")
    assert film.is_ordered
    found = names_and_times(tmp_path / "images", images=tmp_path / "photos")
    assert found == [("img_2.png", 2.0), ("img_9.png", 9.0), ("img_10.png", 10.0)]
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "images" / "img_9.png")), noise(9))


def test_hidden_files_are_no_images(tmp_path: Path) -> None:
    for number in (1, 2):
        save(tmp_path / f"all/{number}.png", noise(number))
    (tmp_path / "all/._1.jpg").write_bytes(b"of a Mac")
    found = names_and_times(tmp_path / "out", images=tmp_path / "all")
    assert len(found) == 2


def test_images_without_numbers_are_in_no_order(tmp_path: Path) -> None:
    for name in ("tree", "door", "house"):
        save(tmp_path / "photos" / f"{name}.jpg", noise(1))
    (film,) = find_films(images=tmp_path / "photos")
    assert not film.is_ordered
    assert names_and_times(tmp_path / "images", images=tmp_path / "photos")[0] == ("door.png", 0.0)


def test_images_are_turned_upright_and_reduced_to_the_width(tmp_path: Path) -> None:
    turned = Image.Exif()
    turned[0x0112] = 6
    (tmp_path / "photos").mkdir()
    for index in range(2):
        Image.fromarray(noise(index)).save(tmp_path / "photos" / f"{index}.jpg", exif=turned)
    frames = choose_frames(find_films(images=tmp_path / "photos"), tmp_path / "images", None, 32)
    assert [frame.size for frame in frames] == [(24, 32)] * 2
    assert Image.open(tmp_path / "images" / frames[0].name).size == (24, 32)


def write_wrong(folder: Path) -> None:
    (folder / "empty.mp4").touch()
    (folder / "text.mp4").write_text("no film")
    (folder / "nothing").mkdir()
    for end in ("png", "jpg"):
        save(folder / "twice" / f"1.{end}", noise(0))


@pytest.mark.parametrize(("sources", "said"), [
    ({}, "give video=film.mp4"),
    ({"video": "a", "images": "b"}, "one of them only"),
    ({"video": "nowhere.mp4"}, "nowhere.mp4 does not exist"),
    ({"video": "empty.mp4"}, "is empty, of 0 bytes"),
    ({"video": "text.mp4"}, "cannot be decoded.*ffmpeg -i text.mp4"),
    ({"video": "nothing"}, "must hold videos"),
    ({"images": "nothing"}, "must hold PNG or JPEG images.*got 0"),
    ({"images": "nowhere"}, "must hold PNG or JPEG images"),
    ({"images": "twice"}, "different names"),
])  # fmt: skip
def test_what_cannot_be_a_film_is_refused_in_words(tmp_path: Path, sources: dict[str, str], said: str) -> None:
    write_wrong(tmp_path)
    with pytest.raises(ValueError, match=said):
        choose_frames(find_films(**{k: tmp_path / v for k, v in sources.items()}), tmp_path / "images", None, 64)
    assert not list((tmp_path / "images").rglob("*.png"))
