import math
import resource
from collections.abc import Iterator
from pathlib import Path

import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

from dnerf.visualization.colours import COLORMAPS, error_map
from dnerf.visualization.video import comparison_sheet, contact_sheet, to_uint8, write_frames, write_png


def smooth_frames(number: int, height: int = 64, width: int = 96) -> list[Tensor]:
    """Colour ramps that move, as smooth as video is."""
    y, x = torch.meshgrid(torch.linspace(0.2, 0.8, height), torch.linspace(0.2, 0.8, width), indexing="ij")
    return [torch.stack([x, y, torch.full_like(x, i / max(number - 1, 1))], dim=-1) for i in range(number)]


def read_mp4(path: Path) -> np.ndarray:
    with imageio.get_reader(path, format="FFMPEG") as reader:
        return np.stack([frame for frame in reader])


def test_to_uint8_rounds_to_the_nearest_clamps_and_keeps_uint8() -> None:
    values = torch.tensor([-1.0, 0.0, 0.49 / 255, 0.51 / 255, 127.4 / 255, 127.6 / 255, 1.0, 7.0])
    assert to_uint8(values).tolist() == [0, 0, 0, 1, 127, 128, 255, 255]
    levels = torch.arange(256, dtype=torch.uint8)
    assert torch.equal(to_uint8(levels), levels)


@given(st.integers(0, 255))
def test_to_uint8_is_exact_on_whole_levels(level: int) -> None:
    assert int(to_uint8(torch.tensor(level / 255))) == level
    assert int(to_uint8(np.float64(level / 255) * np.ones(1))[0]) == level


@pytest.mark.parametrize("values", [[0.5, math.nan], [0.5, math.inf], [0.5, -math.inf], [1, 2]])
def test_to_uint8_refuses_what_is_not_finite_and_other_integers(values: list[float]) -> None:
    with pytest.raises(ValueError, match=r"images must be finite|images must be float or uint8, got torch.int64"):
        to_uint8(torch.tensor(values))


@pytest.mark.parametrize(("height", "width"), [(64, 96), (63, 96), (64, 95), (65, 97)])
def test_mp4_shows_the_images_and_pads_odd_sizes_by_repetition(tmp_path: Path, height: int, width: int) -> None:
    frames = smooth_frames(6, height, width)
    path = write_frames((f for f in frames), tmp_path / "new" / "a.mp4", fps=12)
    video = read_mp4(path)
    assert video.shape == (6, height + height % 2, width + width % 2, 3)
    truth = torch.stack(frames).numpy() * 255
    # lossy by about 1.3 levels of 255; BT.601 taken for BT.709 costs 4.8
    assert np.abs(video[:, :height, :width] - truth).mean() < 2
    assert np.abs(video[:, -1].astype(float) - video[:, -2]).mean() < 8


def test_mp4_keeps_pixels_in_place_and_white_white_in_the_quality_asked_for(tmp_path: Path) -> None:
    """An odd size that was scaled rather than padded would move the edges."""
    image = torch.ones(41, 67, 3)
    image[:30, :50] = 0
    video = read_mp4(write_frames([image] * 3, tmp_path / "a.mp4")).astype(int)
    np.testing.assert_array_equal(video[2, :41, :67].mean(-1) > 127, image.mean(-1) > 0.5)
    assert video[2, -8:, -8:].min() >= 253
    assert video[2, :20, :40].max() <= 2
    frames = [torch.rand(32, 48, 3) for _ in range(4)]
    sizes = [write_frames(frames, tmp_path / f"{q}.mp4", quality=q).stat().st_size for q in (2, 5, 9)]
    assert sizes[0] < sizes[1] < sizes[2]


def test_mp4_has_the_frame_rate_and_tags_that_players_need(tmp_path: Path) -> None:
    path = write_frames(smooth_frames(10), tmp_path / "a.mp4", fps=25)
    with imageio.get_reader(path, format="FFMPEG") as reader:
        meta = reader.get_meta_data()
    assert meta["fps"] == 25
    assert meta["codec"] == "h264"
    # One word says that matrix, primaries and transfer are the same; "bt709/unknown/unknown" that they are not.
    assert meta["pix_fmt"].startswith(("yuv420p(tv, bt709)", "yuv420p(tv, bt709, "))
    assert path.read_bytes().count(b"colrnclx\x00\x01\x00\x01\x00\x01") == 1
    assert meta["duration"] == pytest.approx(0.4, abs=0.02)


def test_a_video_that_does_not_fit_the_disk_is_an_error_and_vanishes(tmp_path: Path) -> None:
    frames = [torch.rand(64, 64, 3) for _ in range(8)]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(OSError):
            write_frames(frames, tmp_path / "a.mp4", quality=10)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not any(tmp_path.iterdir())


def test_a_video_that_lacks_frames_is_an_error_and_vanishes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imageio_ffmpeg, "count_frames_and_secs", lambda path: (3, 0.1))
    with pytest.raises(OSError, match="ffmpeg wrote 3 of 4 frames"):
        write_frames(smooth_frames(4), tmp_path / "a.mp4")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("fps", "expected"),
    [(30, [30, 40, 30, 30, 40, 30]), (25, [40] * 6), (50, [20] * 6), (10, [100] * 6), (24, [40, 40, 50, 40, 40, 40])],
)
def test_gif_loops_with_durations_that_stay_in_time(tmp_path: Path, fps: float, expected: list[int]) -> None:
    path = write_frames(smooth_frames(6), tmp_path / "a.gif", fps=fps)
    durations = []
    with Image.open(path) as gif:
        assert gif.info["loop"] == 0
        for index in range(gif.n_frames):
            gif.seek(index)
            durations.append(gif.info["duration"])
    assert durations == expected
    assert abs(sum(durations) - 6000 / fps) <= 5  # half a tick, in ms


def test_gif_shows_the_images(tmp_path: Path) -> None:
    frames = smooth_frames(3)
    path = write_frames(frames, tmp_path / "a.gif", fps=10)
    with Image.open(path) as gif:
        for index, frame in enumerate(frames):
            gif.seek(index)
            shown = np.asarray(gif.convert("RGB")).astype(float)
            # 256 colours for a ramp of 1536
            assert np.abs(shown - frame.numpy() * 255).mean() < 8


def test_png_frames_are_exact_and_numbered(tmp_path: Path) -> None:
    frames = [torch.rand(5, 7, 3) for _ in range(3)]
    folder = write_frames((f for f in frames), tmp_path / "a" / "frames")
    assert sorted(p.name for p in folder.iterdir()) == [f"frame_0000{i}.png" for i in range(3)]
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(np.asarray(Image.open(folder / f"frame_0000{i}.png")), to_uint8(frame))


def test_png_frames_replace_earlier_ones_but_no_other_files(tmp_path: Path) -> None:
    frames = smooth_frames(3)
    write_frames(frames, tmp_path / "frames", "png")
    write_frames(frames[:1], tmp_path / "frames", "png")
    assert [p.name for p in (tmp_path / "frames").iterdir()] == ["frame_00000.png"]
    (tmp_path / "frames" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="path must be a new folder or one of earlier frames"):
        write_frames(frames, tmp_path / "frames", "png")
    assert len(list((tmp_path / "frames").iterdir())) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["frames"]


@pytest.mark.parametrize("name", ["a.mp4", "frames"])
def test_frames_stream_one_at_a_time(tmp_path: Path, name: str) -> None:
    """The image before the last one taken must be free by the time the next is asked for."""
    alive: list[int] = []

    class Counted(np.ndarray):
        def __del__(self) -> None:
            if self.base is None:
                alive.append(-1)

    def frames() -> Iterator[np.ndarray]:
        for _ in range(8):
            array = Counted((16, 16, 3), np.float32)
            array[:] = 0.5
            alive.append(1)
            yield array
            del array
            assert sum(alive) <= 2

    write_frames(frames(), tmp_path / name, fps=10)
    assert alive.count(1) == 8


def interrupted() -> Iterator[Tensor]:
    yield from smooth_frames(3)
    raise RuntimeError("rendering failed")


def mixed() -> Iterator[Tensor]:
    yield torch.zeros(16, 16, 3)
    yield torch.zeros(16, 18, 3)


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "frames"])
def test_after_an_error_the_old_file_stands_and_nothing_else(tmp_path: Path, name: str) -> None:
    write_frames(smooth_frames(2), tmp_path / name, fps=10)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(RuntimeError, match="rendering failed"):
        write_frames(interrupted(), tmp_path / name, fps=10)
    with pytest.raises(ValueError, match=r"images\[1\] must have shape \(16, 16, 3\) as the first"):
        write_frames(mixed(), tmp_path / name, fps=10)
    with pytest.raises(ValueError, match="images must hold at least one frame, got none"):
        write_frames([], tmp_path / name, fps=10)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("shape", [(16, 16), (16, 16, 4), (0, 16, 3), (1, 16, 16, 3)])
def test_what_is_no_image_is_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"images\[0\] must have shape \(H, W, 3\)"):
        write_frames([torch.zeros(shape)], tmp_path / "a.mp4")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("path", "arguments", "message"),
    [
        ("folder.mp4", {}, "path must be a file"),
        ("a.webm", {}, "format must be one of mp4, gif, png; got 'webm'"),
        ("a.mp4", {"format": "avi"}, "format must be one of"),
        ("a", {"format": "mp4"}, "path must be a file that ends in .mp4"),
        ("a.mp4", {"format": "gif"}, "path must be a file that ends in .gif"),
        ("a.mp4", {"fps": 0}, "fps must be > 0"),
        ("a.mp4", {"fps": math.nan}, "fps must be > 0"),
        ("a.gif", {"fps": 60}, "fps must be at most 50 for gif"),
        ("a.mp4", {"quality": 11}, r"quality must be in \[0, 10\], got 11"),
        ("a.mp4", {"quality": math.nan}, r"quality must be in \[0, 10\], got nan"),
    ],
)
def test_senseless_arguments_are_refused(tmp_path: Path, path: str, arguments: dict, message: str) -> None:
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(ValueError, match=message):
        write_frames(smooth_frames(2), tmp_path / path, **arguments)
    assert [found.name for found in tmp_path.rglob("*")] == ["folder.mp4"]


@given(height=st.integers(1, 8), width=st.integers(1, 8), seed=st.integers(0, 2**31))
def test_write_png_is_exact(tmp_path_factory: pytest.TempPathFactory, height: int, width: int, seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    path = write_png(image, tmp_path_factory.mktemp("png") / "a.png")
    np.testing.assert_array_equal(np.asarray(Image.open(path)), image)


def test_error_map_grows_from_black_to_brightest_at_the_stated_error() -> None:
    target = torch.full((2, 3, 3), 0.25)
    prediction = target.clone()
    prediction[0, 1] += 0.1
    prediction[0, 2] += 0.2
    prediction[1, 0] += 0.7
    prediction[1, 1, 0] -= 0.15  # 0.05 on average over channels
    colors = to_uint8(error_map(prediction, target, max_error=0.2))
    table = [list(bytes.fromhex(c)) for c in COLORMAPS["inferno"].split()]
    assert colors[0, 0].tolist() == table[0]
    assert colors[0, 1].tolist() == table[8]
    assert colors[0, 2].tolist() == colors[1, 0].tolist() == table[16]
    assert colors[1, 1].tolist() == table[4]
    error = torch.linspace(0, 1, 200)[None, :, None].expand(1, 200, 3)
    colors = error_map(error, torch.zeros_like(error), max_error=1.0)
    luminance = colors @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert (luminance.diff() > 0).all()


@pytest.mark.parametrize(
    ("shapes", "max_error"), [(((2, 2, 3), (2, 3, 3)), 0.2), (((2, 2), (2, 2)), 0.2), (((2, 2, 3), (2, 2, 3)), 0.0)]
)
def test_error_map_refuses_what_does_not_fit(shapes: tuple, max_error: float) -> None:
    with pytest.raises(ValueError, match="must"):
        error_map(torch.zeros(shapes[0]), torch.zeros(shapes[1]), max_error)


@pytest.mark.parametrize("rows", [(), ("t = 0", "t = 1")])
@pytest.mark.parametrize(("height", "width"), [(40, 60), (400, 400), (12, 8)])
def test_contact_sheet_holds_every_image_once_in_order(rows: tuple[str, ...], height: int, width: int) -> None:
    # not grey, unlike text and frames
    colors = [torch.tensor([40 * i + 20, 0, 200], dtype=torch.uint8) for i in range(6)]
    tiles = [color.expand(height, width, 3) for color in colors]
    sheet = contact_sheet([tiles[:3], tiles[3:]], ["prediction", "truth", "error"], rows)
    places = []
    for color in colors:
        inside = (sheet == color).all(-1)
        top, left = inside.nonzero()[0].tolist()
        assert inside[top : top + height, left : left + width].all()
        assert int(inside.sum()) == height * width
        places.append((top, left))
    tops, lefts = [p[0] for p in places], [p[1] for p in places]
    assert tops[0] == tops[1] == tops[2] < tops[3] == tops[4] == tops[5]
    assert lefts[0] == lefts[3] < lefts[1] == lefts[4] < lefts[2] == lefts[5]
    assert tops[3] - tops[0] >= height + 8
    assert lefts[1] - lefts[0] >= width + 8
    # headings are written above, labels on the left, and nothing touches the rim
    assert bool((sheet[: tops[0] - 2] < 128).any())
    assert bool((sheet[tops[0] :, : lefts[0] - 2] < 128).any()) == bool(rows)
    rim = torch.cat([sheet[0], sheet[-1], sheet[:, 0], sheet[:, -1]])
    assert (rim == 255).all()


@pytest.mark.parametrize(
    ("images", "columns", "rows"),
    [
        ([], ["a"], []), ([[]], [], []), ([[torch.zeros(4, 4)]], ["a"], []),
        ([[torch.zeros(4, 4, 3)]], ["a", "b"], []), ([[torch.zeros(4, 4, 3)]], ["a"], ["x", "y"]),
        ([[torch.zeros(4, 4, 3), torch.zeros(4, 5, 3)]], ["a", "b"], []),
    ],
)  # fmt: skip
def test_contact_sheet_refuses_what_does_not_fit(images: list, columns: list, rows: list) -> None:
    with pytest.raises(ValueError, match=r"images|rows"):
        contact_sheet(images, columns, rows)


def test_a_comparison_shows_prediction_truth_and_error() -> None:
    prediction, truth = torch.zeros(20, 30, 3), torch.full((20, 30, 3), 0.5)
    columns = ["prediction", "truth", "error (yellow: 0.2 or more)"]
    expected = contact_sheet([[prediction, truth, error_map(prediction, truth)]], columns, ["a"])
    assert torch.equal(comparison_sheet([(prediction, truth)], ["a"]), expected)
