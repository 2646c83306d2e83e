import io
import pickle
import time
from pathlib import Path

import data_folders
import imageio.v2 as imageio
import numpy as np
import pytest
from data_folders import NUM_FRAMES, llff_rows

from dnerf.data.formats import read_capture
from dnerf.data.formats.points import read_npy


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return data_folders.write_llff(tmp_path / "scene")


def test_a_row_written_out_by_hand(root: Path) -> None:
    """A camera at (1, 2, 3) that looks along +x with z up: down -z, right -y, back -x."""
    matrix = [[0, 0, -1, 1, 6], [0, -1, 0, 2, 8], [-1, 0, 0, 3, 9.5]]
    np.save(root / "poses_bounds.npy", np.array([[*np.ravel(matrix), 2, 6]] * NUM_FRAMES, dtype=">f4"))
    frame = read_capture(root).splits["all"][0]
    assert frame.pose == ((0, 0, -1, 1), (-1, 0, 0, 2), (0, 1, 0, 3), (0, 0, 0, 1))


def test_planes_are_the_nearest_and_furthest_and_nonsense_is_left_out(root: Path) -> None:
    rows = llff_rows()
    rows[1, 15], rows[2, 16] = 0.5, 99
    np.save(root / "poses_bounds.npy", rows)
    assert read_capture(root).planes == (0.5, 99)
    rows[:, 15] = -1
    np.save(root / "poses_bounds.npy", rows)
    capture = read_capture(root)
    assert capture.planes is None
    assert "near and far are not used" in capture.notes[-1]


@pytest.mark.parametrize("folder", ["cam{:02d}", "cam{:02d}/images", "view{}/images_2"])
def test_cameras_may_have_a_folder_each(tmp_path: Path, folder: str) -> None:
    root = tmp_path / "scene"
    for camera in range(NUM_FRAMES):
        for moment in (0, 10, 20):
            data_folders.write_image(root / folder.format(camera) / f"{moment:04d}.png", moment)
    np.save(root / "poses_bounds.npy", llff_rows())
    frames = read_capture(root).splits["all"]
    assert [frame.time for frame in frames] == [0, 10, 20] * NUM_FRAMES
    np.testing.assert_allclose([frame.pose for frame in frames[::3]], data_folders.poses(), atol=1e-12)
    assert len({frame.name for frame in frames}) == 3 * NUM_FRAMES


def test_cameras_may_have_a_video_each(tmp_path: Path) -> None:
    root = tmp_path / "scene"
    root.mkdir()
    for camera in range(NUM_FRAMES):
        with imageio.get_writer(root / f"cam{camera:02d}.mp4", fps=30) as writer:
            for moment in range(5):
                writer.append_data(np.full((16, 16, 3), 40 * moment, np.uint8))
    np.save(root / "poses_bounds.npy", llff_rows())
    frames = read_capture(root).splits["all"]
    assert [frame.time for frame in frames] == [0, 1, 2, 3, 4] * NUM_FRAMES
    assert [frame.image.frame for frame in frames if frame.image] == [0, 1, 2, 3, 4] * NUM_FRAMES
    assert [frames[0].name, frames[9].name] == ["cam00/00000", "cam01/00004"]
    np.testing.assert_allclose([frame.pose for frame in frames[::5]], data_folders.poses(), atol=1e-12)
    (root / "cam02.mp4").write_bytes(b"#EXTM3U\n/etc/passwd\n")
    with pytest.raises(ValueError, match=r"cam02.mp4: video cannot be decoded"):
        read_capture(root)


def test_names_without_numbers_give_no_time_and_reduced_images_are_found(root: Path) -> None:
    for old, new in zip(sorted((root / "images").iterdir()), "abcd"):
        old.rename(old.with_name(f"{new}.png"))
    (root / "images").rename(root / "images_4")
    frames = read_capture(root).splits["all"]
    assert [frame.time for frame in frames] == [None] * NUM_FRAMES
    assert [frame.name for frame in frames] == [f"images_4/{name}" for name in "abcd"]


def test_as_many_images_as_cameras_are_wanted(root: Path) -> None:
    (root / "images/0002.png").unlink()
    with pytest.raises(
        ValueError, match=r"has 4 cameras, so there must be as many images .* got 3 images in images/; re"
    ):
        read_capture(root)


def header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize(("content", "message"), [
    (b"", "not a .npy file"),
    (b"\x93NUMPY\x07\x00", "not a .npy file"),
    (
        header("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 17), }\n"),
        "must hold .* numbers, got 0",
    ),
    (header("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -17), }\n") + bytes(136), "must hold"),
    (header("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }\n") + pickle.dumps([1]), "floating-point"),
    (header("__import__('os').system('true')\n"), "not a .npy file"),
    (header("(" * 9000), "not a .npy file"),
])  # fmt: skip
def test_hostile_arrays_are_refused_at_once(root: Path, content: bytes, message: str) -> None:
    (root / "poses_bounds.npy").write_bytes(content)
    begin = time.process_time()
    with pytest.raises(ValueError, match=message) as caught:
        read_capture(root)
    assert time.process_time() - begin < 1
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("rows", "message"), [
    (np.zeros((4, 15)), r"must be an array of cameras x 17, got \(4, 15\)"),
    (np.zeros((0, 17)), "must be an array of cameras x 17"),
    (np.full((4, 17), np.nan), "must hold finite numbers"),
    (np.zeros((4, 17)), "row 0"),
    (np.zeros((4, 17), int), "must hold floating-point numbers"),
])  # fmt: skip
def test_senseless_rows_are_refused(root: Path, rows: np.ndarray, message: str) -> None:
    np.save(root / "poses_bounds.npy", rows)
    with pytest.raises(ValueError, match=message):
        read_capture(root)


def test_arrays_of_any_order_and_precision_are_read(tmp_path: Path) -> None:
    values = np.arange(12.0).reshape(3, 4)
    for array in (values, np.asfortranarray(values), values.astype(">f4"), values.astype(np.float16)):
        np.save(tmp_path / "a.npy", array)
        np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), values)
    file = io.BytesIO()
    np.lib.format.write_array(file, values, version=(2, 0))
    (tmp_path / "a.npy").write_bytes(file.getvalue())
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), values)
