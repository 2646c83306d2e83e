import struct
import time
from pathlib import Path

import data_folders
import numpy as np
import pytest
from data_folders import NUM_FRAMES

from dnerf.core.lenses import Distortion
from dnerf.data.formats import read_capture

SPARSE = "sparse/0"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return data_folders.write_colmap(tmp_path / "scene", binary=False)


@pytest.fixture
def binary(tmp_path: Path) -> Path:
    return data_folders.write_colmap(tmp_path / "binary")


def test_a_camera_written_out_by_hand(root: Path) -> None:
    """Half a turn about x maps world to camera: the camera looks along -z, with y up, from (-1, 2, 3)."""
    (root / SPARSE / "images.txt").write_text("1 0 1 0 0 1 2 3 1 0000.png\n\n")
    frame = read_capture(root).splits["all"][0]
    np.testing.assert_allclose(np.array(frame.pose), [[1, 0, 0, -1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=0)


@pytest.mark.parametrize(("line", "focal", "center", "distortion"), [
    ("SIMPLE_PINHOLE 8 6 9 4 3", (9, 9), (4, 3), None),
    ("PINHOLE 8 6 9 10 4 3", (9, 10), (4, 3), None),
    ("SIMPLE_RADIAL 8 6 9 4 3 0.1", (9, 9), (4, 3), Distortion("opencv", (0.1,))),
    ("RADIAL 8 6 9 4 3 0.1 0.01", (9, 9), (4, 3), Distortion("opencv", (0.1, 0.01))),
    ("OPENCV 8 6 9 10 4 3 0 0 0 0", (9, 10), (4, 3), None),
    ("OPENCV 8 6 9 10 4 3 0.1 0 0.01 0.02", (9, 10), (4, 3), Distortion("opencv", (0.1, 0.0), (0.01, 0.02))),
    (
        "FULL_OPENCV 8 6 9 10 4 3 0.1 0.2 0.001 0.002 0.3 0.4 0.5 0.6", (9, 10), (4, 3),
        Distortion("opencv", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6), (0.001, 0.002)),
    ),
    ("OPENCV_FISHEYE 8 6 9 10 4 3 0.1 0 0 0", (9, 10), (4, 3), Distortion("fisheye", (0.1, 0, 0, 0))),
    ("SIMPLE_RADIAL_FISHEYE 8 6 9 4 3 0.1", (9, 9), (4, 3), Distortion("fisheye", (0.1,))),
    ("RADIAL_FISHEYE 8 6 9 4 3 0.1 0.01", (9, 9), (4, 3), Distortion("fisheye", (0.1, 0.01))),
])  # fmt: skip
def test_camera_models_are_colmaps(
    root: Path, line: str, focal: tuple, center: tuple, distortion: Distortion | None
) -> None:
    (root / SPARSE / "cameras.txt").write_text(f"1 {line}\n")
    camera = read_capture(root).splits["all"][0].intrinsics
    assert (camera.width, camera.height, camera.distortion) == (8, 6, distortion)
    assert (camera.focal_x, camera.focal_y) == focal
    assert (camera.center_x, camera.center_y) == center


def test_frames_are_in_the_order_of_names_with_the_numbers_in_them_as_times(root: Path) -> None:
    path = root / SPARSE / "images.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], *lines[5:7], *lines[1:3], *lines[7:9], *lines[3:5]]))
    capture = read_capture(root)
    assert [frame.time for frame in capture.splits["all"]] == [0, 1, 2, 3]
    assert "data.times=static if nothing moves" in capture.notes[0]


@pytest.mark.parametrize("dialect", ["no line of points", "empty lines", "windows", "names with spaces"])
def test_dialects_of_text_are_read(root: Path, dialect: str) -> None:
    path = root / SPARSE / "images.txt"
    text = path.read_text()
    if dialect == "no line of points":
        text = text.replace("1.5 2.5 -1 3.5 4.5 2\n", "")
    elif dialect == "empty lines":
        text = text.replace("1.5 2.5 -1 3.5 4.5 2\n", "\n")
    elif dialect == "windows":
        text = text.replace("\n", "\r\n")
    else:
        text = text.replace("0002.png", "my image 2.png")
        (root / "images/0002.png").rename(root / "images/my image 2.png")
    path.write_text(text, newline="")
    frames = read_capture(root).splits["all"]
    assert len(frames) == NUM_FRAMES
    np.testing.assert_allclose(np.array(frames[0].pose), data_folders.poses()[0], atol=1e-12)


@pytest.mark.parametrize("place", ["sparse", "colmap/sparse/0", "."])
def test_models_and_images_are_found_where_tools_put_them(binary: Path, place: str) -> None:
    (binary / SPARSE).rename(binary / "model")
    (binary / "sparse").rmdir()
    (binary / place).mkdir(parents=True, exist_ok=True)
    for path in (binary / "model").iterdir():
        path.rename(binary / place / path.name)
    (binary / "model").rmdir()
    (binary / "images").rename(binary / "input")
    frames = read_capture(binary).splits["all"]
    assert [f.image.path.parent.name for f in frames if f.image] == ["input"] * NUM_FRAMES


def test_masks_named_as_colmap_does_are_found(root: Path) -> None:
    data_folders.write_image(root / "masks/0001.png.png", 0, 3)
    assert [f.mask for f in read_capture(root).splits["all"]] == [None, root / "masks/0001.png.png", None, None]


@pytest.mark.parametrize(("file", "content", "message"), [
    ("cameras.txt", "1 PINHOLE 8 6 9 9 4\n", "line 1 must be .*: PINHOLE must have 4 parameters, got 3"),
    ("cameras.txt", "1 MAGIC 8 6 9\n", "model must be one of SIMPLE_PINHOLE, .*, got 'MAGIC'"),
    ("cameras.txt", "1 FOV 8 6 9 9 4 3 1\n", "FOV are not supported; run COLMAP's image_undistorter"),
    ("cameras.txt", "1 PINHOLE 8 6 nan 9 4 3\n", "parameters must be finite"),
    ("cameras.txt", "1 PINHOLE 0 6 9 9 4 3\n", "width and height must be in 1..131072, got 0 x 6"),
    ("cameras.txt", "1 PINHOLE 8 6 0 9 4 3\n", "focal length must fit 8 x 6, got 0"),
    ("cameras.txt", "2 PINHOLE 8 6 9 9 4 3\n", "camera 1 is not in the model"),
    ("images.txt", "# nothing\n", "the model has no registered image"),
    ("images.txt", "1 1 0 0 0 1 2 3 1 ../../x.png\n\n", "names must be paths below .*, got '../../x.png'"),
    ("images.txt", "1 1 0 0 0 1 2 3 1\n\n", "names must be paths below"),
    ("images.txt", "1 0 0 0 0 1 2 3 1 0000.png\n\n", "quaternion and translation must be finite"),
    ("images.txt", "1 x 0 0 0 1 2 3 1 0000.png\n\n", "line 1 must be number, quaternion"),
    ("images.txt", "1 1 0 0 0 1 2 3 1 none.png\n\n", "none of the model's images is there, looked for images/none"),
    ("points3D.txt", "1 2 x 4\n", "points3D.txt: line 1 must begin with a number and a position"),
])  # fmt: skip
def test_bad_text_is_named_in_one_line(root: Path, file: str, content: str, message: str) -> None:
    (root / SPARSE / file).write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_capture(root)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("file", "content", "message"), [
    ("cameras.bin", b"", "cameras.bin: file is truncated at byte 0"),
    ("cameras.bin", struct.pack("<Q", 2**63), "cameras must be at most 10000 and within the file"),
    ("cameras.bin", struct.pack("<Qii2Q4d", 1, 1, 99, 8, 6, 1, 1, 1, 1), "of a known model, got number 99"),
    ("images.bin", struct.pack("<Q", 2**40), "images must be at most 10000 and within the file"),
    (
        "images.bin", struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"x" * 9000,
        "name at byte 72 must end within 4096 bytes",
    ),
    (
        "images.bin", struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"0000.png\0" + b"\xff" * 8,
        "points of an image must be at most .* got 18446744073709551615",
    ),
    ("points3D.bin", struct.pack("<Q", 2**40) + bytes(51), "points must be at most .* and within the file"),
    ("points3D.bin", struct.pack("<Q", 1) + bytes(43) + struct.pack("<Q", 2**60), "track of a point must be at most"),
])  # fmt: skip
def test_absurd_lengths_in_binary_models_are_refused_at_once(
    binary: Path, file: str, content: bytes, message: str
) -> None:
    (binary / SPARSE / file).write_bytes(content)
    begin = time.process_time()
    with pytest.raises(ValueError, match=message) as caught:
        read_capture(binary)
    assert time.process_time() - begin < 1
    assert "\n" not in str(caught.value)


def test_text_and_binary_are_the_same(root: Path, binary: Path) -> None:
    text, other = read_capture(root), read_capture(binary)
    for one, two in zip(text.splits["all"], other.splits["all"]):
        assert (one.name, one.pose, one.intrinsics, one.time) == (two.name, two.pose, two.intrinsics, two.time)
    assert text.points is not None
    assert text.points.equal(other.points)  # type: ignore[arg-type]
