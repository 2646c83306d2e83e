"""Fields of `transforms*.json`: what is used, what is repaired with a note, and what is refused, and in which words."""

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import data_folders
import numpy as np
import pytest
from data_folders import FOCAL, NUM_FRAMES, WIDTH

from dnerf.core.lenses import Distortion
from dnerf.data.capture import Capture, CaptureFrame
from dnerf.data.formats import read_capture
from dnerf.data.formats.json_files import MAX_BYTES, MAX_FRAMES

Edit = Callable[[dict[str, Any]], object]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return data_folders.write_blender(tmp_path / "scene")


def edited(root: Path, edit: Edit, file: str = "transforms_train.json") -> Path:
    value = json.loads((root / file).read_text())
    edit(value)
    (root / file).write_text(json.dumps(value))
    return root


def frame(index: int = 1, **changes: object) -> Edit:
    """Change fields of one frame; `...` removes one."""

    def edit(manifest: dict[str, Any]) -> None:
        target = manifest["frames"][index]
        for field, value in changes.items():
            if value is ...:
                del target[field]
            else:
                target[field] = value

    return edit


def all_frames(**changes: object) -> Edit:
    def edit(manifest: dict[str, Any]) -> None:
        for index in range(len(manifest["frames"])):
            frame(index, **changes)(manifest)

    return edit


def top(**changes: object) -> Edit:
    def edit(manifest: dict[str, Any]) -> None:
        manifest.update(changes)
        for field in [f for f, value in changes.items() if value is ...]:
            del manifest[field]

    return edit


def entry(row: int, column: int, value: object) -> Edit:
    def edit(manifest: dict[str, Any]) -> None:
        manifest["frames"][1]["transform_matrix"][row][column] = value

    return edit


def train(capture: Capture) -> tuple[CaptureFrame, ...]:
    return capture.splits["train"]


MATRIX = r"frames\[1\].transform_matrix"


@pytest.mark.parametrize(("edit", "message"), [
    (lambda m: m.pop("frames"), r"frames must be a list with at least one frame, got None"),
    (top(frames=[]), r"frames must be a list with at least one frame, got \[\]"),
    (top(frames={"a": 1}), r"frames must be a list"),
    (lambda m: m["frames"].insert(1, "x"), r"frames\[1\] must be an object, got 'x'"),
    (frame(time=...), r"frames\[1\].time is missing, other frames have it; give it to all, or to none"),
    (lambda m: m.update(frames=dict(enumerate(m["frames"]))), r"frames must be a list .{,165}\.\.\.$"),
    (frame(time=math.nan), r"frames\[1\].time must be a number .* got nan; export it again, or take"),
    (frame(time="0.5"), r"frames\[1\].time must be a number .* got '0.5'; write it without quotes"),
    (frame(time=True), r"frames\[1\].time must be a number .* got True"),
    (frame(time=10**400), r"frames\[1\].time must be a number .* got 1000"),
    (frame(transform_matrix=...), r"frames\[1\].transform_matrix is missing"),
    (frame(transform_matrix=[[1, 0], [0, 1]]), MATRIX + " must be a list of 4 lists of 4 numbers or a list of 3"),
    (frame(transform_matrix="eye"), MATRIX + " must be a list of 4 lists of 4"),
    (entry(0, 3, math.nan), MATRIX + r"\[0\]\[3\] must be a number .* got nan"),
    (entry(1, 1, None), MATRIX + r"\[1\]\[1\] must be a number .* got None"),
    (entry(2, 2, 1.1), MATRIX + r" must be rigid: three orthonormal columns .*; export it without shear"),
    (entry(3, 0, 0.5), MATRIX + r" must have the last row 0 0 0 1, got \[0.5 0 0 1\]"),
    (
        frame(transform_matrix=np.array(data_folders.poses()[1]).T.tolist()),
        MATRIX + " must have the last row 0 0 0 1, .*; it looks transposed: list rows",
    ),
    (
        frame(transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()),
        MATRIX + r" must be rigid and right-handed, it mirrors \(determinant -1\); negate one axis",
    ),
    (frame(transform_matrix=np.diag([0.0, 0, 0, 1]).tolist()), MATRIX + r" must be rigid"),
    (frame(file_path=...), r"frames\[1\].file_path is missing"),
    (frame(file_path=3), r"frames\[1\].file_path must be printable text, got 3"),
    (frame(file_path="train/r_1\0"), r"frames\[1\].file_path must be printable text, got 'train/r_1\\x00'"),
    (frame(file_path="train/\ud800"), r"frames\[1\].file_path must be printable text"),
    (frame(file_path="x" * 5000), r"frames\[1\].file_path must be printable text"),
    (frame(file_path="ü" * 200), r"frames\[1\].file_path must have names of at most 255 bytes"),
    (frame(file_path=""), r"frames\[1\].file_path must be printable text"),
    (frame(file_path="."), r"frames\[1\].file_path must stay inside"),
    (frame(file_path="/etc/passwd"), r"frames\[1\].file_path must stay inside .*; write it relative to"),
    (frame(file_path="C:\\x\\y.png"), r"frames\[1\].file_path must stay inside"),
    (frame(file_path="../../etc/passwd"), r"frames\[1\].file_path must stay inside"),
    (all_frames(file_path="train/gone"), r"none of its 4 images is there, the first is .*train/gone; put them"),
    (frame(mask_path="masks/m.png"), r"frames\[1\].mask_path: no mask .*; put it there, or remove mask_path"),
    (frame(mask_path=3), r"frames\[1\].mask_path must be printable text"),
    (top(near=7.0, far=6.0), "near must be less than far, got 7 and 6"),
    (top(near=-1), "near must be a number"),
    (top(background="white"), "background must be a list of 3 numbers, got 'white'"),
    (top(background=[0, 0, 1.5]), r"background\[2\] must be a number in \[0, 1\], got 1.5"),
    (top(pixel_origin="middle"), "pixel_origin must be one of center, corner"),
    (top(pixel_origin=["center"]), "pixel_origin must be one of center, corner"),
    (top(up=[0, 0, 0]), "up must have a length"),
    (top(rolling_shutter=[0, 0, 0, 1]), "rolling_shutter cannot be followed, .* no rolling shutter"),
    (frame(transform_matrix_start=[[1]]), r"frames\[1\].transform_matrix_start cannot be followed"),
    (top(latlong=True), "latlong cannot be followed, got True: .*undistort"),
    (top(white_transparent=True), "white_transparent cannot be followed, .*write an alpha channel"),
])  # fmt: skip
def test_bad_fields_are_named_in_one_line(root: Path, edit: Edit, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        read_capture(edited(root, edit))
    assert str(caught.value).startswith(str(root / "transforms_train.json"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("content", "message"), [
    (b"", "malformed JSON at line 1 column 1"),
    (b'{"frames": [\n  wrong]}', "malformed JSON at line 2 column 3: .*; correct it there, or export it again"),
    (b'{"frames": [1, 2,\n ]}', "malformed JSON at line .*; remove the comma before the bracket"),
    (b'{"frames": 1, }', "malformed JSON at line 1 .*; remove the comma before the bracket"),
    (b'{"frames": }', "malformed JSON at line 1 .*; correct it there"),
    (b"// mine\n{}", "malformed JSON at line 1 column 1: .*; JSON has no comments: remove them"),
    (b"version https://git-lfs.github.com/spec/v1\n", "it is a Git LFS pointer: git lfs pull fetches"),
    ("{}".encode("utf-16"), "not UTF-8 at byte 0; it is UTF-16: save it as UTF-8"),
    (b"[1, 2]", r"must hold an object, got \[1, 2\]"),
    (b'{"frames": "\xff\xfe"}', "not UTF-8 at byte 12"),
    (b"[" * 100_000, "malformed JSON: nested too deeply"),
    (b'{"camera_angle_x": ' + b"1" * 10_000 + b"}", "malformed JSON: Exceeds the limit"),
    (b" " * (MAX_BYTES + 1), "file must be at most 16 MiB"),
    (json.dumps({"frames": [{}] * 100_000}).encode(), f"frames must be at most {MAX_FRAMES}, got 100000"),
])  # fmt: skip
def test_malformed_files_are_refused(root: Path, content: bytes, message: str) -> None:
    (root / "transforms_train.json").write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_capture(root)
    assert "\n" not in str(caught.value)


def test_a_pipe_and_a_folder_are_no_files(root: Path) -> None:
    for make in (os.mkfifo, os.mkdir):
        path = root / "transforms_val.json"
        make(path)
        with pytest.raises(ValueError, match=r"transforms_val.json: file cannot be read: not a regular file"):
            read_capture(root)
        (path.unlink if make is os.mkfifo else path.rmdir)()


@pytest.mark.parametrize(("linked", "target"), [("train", "outside"), ("train/0001.png", "scene2")])
def test_links_out_of_the_folder_are_refused_and_inside_followed(root: Path, linked: str, target: str) -> None:
    """A sibling whose name begins like the folder's is outside, too."""
    place = root / linked
    place.rename(root.parent / target)
    place.symlink_to(root.parent / target)
    with pytest.raises(ValueError, match=r"frames\[.\].file_path must stay inside .*, got a link out of it.*; put the"):
        read_capture(root)
    place.unlink()
    (root.parent / target).rename(root / "elsewhere")
    place.symlink_to(root / "elsewhere")
    (root.parent / "link").symlink_to(root)
    assert len(train(read_capture(root.parent / "link"))) == NUM_FRAMES


# Harmless repairs, each with one note.

REPAIRS = [
    (frame(file_path="train\\0001.png"), "backslashes"),
    (frame(file_path=".\\train/..\\train\\0001.png"), "backslashes"),
    (frame(file_path="/home/someone/scene/train/0001.png"), "leads out of the folder"),
    (frame(file_path="D:\\work\\scene\\train\\0001.png"), "leads out of the folder"),
    (frame(file_path="../scene/train/0001"), "leads out of the folder"),
    (frame(file_path="train/0001.jpg"), r"images named as .jpg were read as .png"),
    (lambda m: m["frames"][1]["transform_matrix"].pop(), "a matrix of 3 rows was completed"),
]


@pytest.mark.parametrize(("edit", "note"), REPAIRS)
def test_harmless_dialects_are_repaired_with_a_note(root: Path, edit: Edit, note: str) -> None:
    plain, capture = read_capture(root), read_capture(edited(root, edit))
    assert train(capture)[1] == train(plain)[1]
    assert any(note in line for line in capture.notes), capture.notes
    assert plain.notes == ()


@pytest.mark.parametrize("suffix", [".PNG", ".JPG", ".jpeg"])
def test_suffixes_of_any_case_are_found(root: Path, suffix: str) -> None:
    (root / "train/0001.png").rename(root / f"train/0001{suffix}")
    for name in ("train/0001", f"train/0001{suffix}"):
        found = train(read_capture(edited(root, frame(file_path=name))))[1]
        assert found.image is not None
        assert found.image.path == root / f"train/0001{suffix}"
        assert found.name == "train/0001"


def test_a_dot_in_a_name_is_no_suffix_and_utf8_with_a_byte_order_mark_is_read(root: Path) -> None:
    for name in ("r_0.5", "été"):
        (root / "train/0001.png").rename(root / f"train/{name}.png")
        path = root / "transforms_train.json"
        path.write_bytes(b"\xef\xbb\xbf" + path.read_text().replace("0001.png", name).encode())
        assert train(read_capture(root))[1].name == f"train/{name}"
        (root / f"train/{name}.png").rename(root / "train/0001.png")
        path.write_text(path.read_bytes()[3:].decode().replace(name, "0001.png"))


def test_a_missing_image_that_is_there_in_another_kind_is_pointed_out(root: Path) -> None:
    for path in [*(root / "train").glob("*.png")]:
        path.rename(path.with_suffix(".HEIC"))
    with pytest.raises(ValueError, match=r"there is \w+\.HEIC: convert them"):
        read_capture(edited(root, frame(file_path="train/0001.png")))


def test_images_of_another_kind_are_named_as_such(root: Path) -> None:
    (root / "train/0001.png").rename(root / "train/0001.webp")
    (root / "train/0001.webp").write_bytes(b"RIFF____WEBP")
    with pytest.raises(ValueError, match=r"train/0001.webp: image must be a PNG or JPEG file; it is WebP .*: convert"):
        read_capture(edited(root, frame(file_path="train/0001.webp")))
    for path in (root / "train").glob("*.png"):
        path.rename(path.with_suffix(".webp"))
    with pytest.raises(ValueError, match=r"none of its 4 .*; there is 0000\.webp: convert them to PNG or JPEG"):
        read_capture(edited(root, lambda m: [one.update(file_path=one["file_path"][:10]) for one in m["frames"]]))


def test_images_that_were_reduced_are_found_in_their_folder(tmp_path: Path) -> None:
    root = data_folders.write_transforms(tmp_path / "scene")
    (root / "images").rename(root / "images_4")
    capture = read_capture(root)
    assert capture.splits["all"][2].image.path == root / "images_4/0002.png"  # type: ignore[union-attr]
    assert "images_4/" in capture.notes[0]


@pytest.mark.parametrize("factor", [0.01, 7.0, 250.0])
def test_a_rotation_with_one_scale_is_divided_by_it(root: Path, factor: float) -> None:
    expected = data_folders.poses()[1]
    scaled = expected.copy()
    scaled[:3, :3] *= factor
    capture = read_capture(edited(root, frame(transform_matrix=scaled.tolist())))
    np.testing.assert_allclose(np.array(train(capture)[1].pose), expected, atol=1e-12)
    assert f"a scale of {factor:g} was divided" in capture.notes[0]


@pytest.mark.parametrize(("decimals", "note"), [(3, "made orthonormal"), (2, "made orthonormal"), (7, None)])
def test_rounded_matrices_become_orthonormal_and_exact_ones_stay(root: Path, decimals: int, note: str | None) -> None:
    rounded = np.round(data_folders.poses()[1], decimals)
    capture = read_capture(edited(root, frame(transform_matrix=rounded.tolist())))
    pose = np.array(train(capture)[1].pose)
    if note is None:
        assert (pose == rounded).all()
        assert capture.notes == ()
        return
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose, rounded, atol=10.0**-decimals)
    assert note in capture.notes[0]


def test_keys_that_nobody_knows_get_one_note_each_and_known_ones_none(root: Path) -> None:
    def edit(manifest: dict[str, Any]) -> None:
        all_frames(rotation=0.1, sharpness=3, depth_path="d", colmap_im_id=4, lens_temperature=20)(manifest)
        top(aabb_scale=4, applied_transform=[[1, 0, 0, 0]], scene_mood="calm", rolling_shutter=None)(manifest)

    assert read_capture(edited(root, edit)).notes == (
        "transforms_train.json: key 'scene_mood' is not known, it was ignored",
        "transforms_train.json: a frame's key 'lens_temperature' is not known, it was ignored (4 times)",
    )


# Cameras.


def intrinsics(root: Path, edit: Edit) -> list[tuple[float, ...]]:
    cameras = [f.intrinsics for f in train(read_capture(edited(root, edit)))]
    lenses = [(c.pinhole, c) for c in cameras]
    return [(c.width, c.height, fx, fy, column + 0.5, row + 0.5) for (fx, fy, column, row), c in lenses]


K = [[9.5, 0, 3.5], [0, 10.5, 2.5], [0, 0, 1]]
OWN = {"fl_x": 9.5, "fl_y": 10.5, "cx": 3.5, "cy": 2.5, "w": 8, "h": 6.0}


@pytest.mark.parametrize(("edit", "expected"), [
    (top(camera_angle_x=2 * math.atan(0.5)), (8, 6, 8, 8, 4, 3)),
    (top(camera_angle_x=2 * math.atan(0.5), camera_angle_y=2 * math.atan(0.25)), (8, 6, 8, 12, 4, 3)),
    (top(camera_angle_x=..., camera_angle_y=2 * math.atan(0.25)), (8, 6, 12, 12, 4, 3)),
    (top(fl_x=9.5), (8, 6, 9.5, 9.5, 4, 3)),
    (top(fl_x=9.5, camera_angle_y=2 * math.atan(0.25)), (8, 6, 9.5, 12, 4, 3)),
    (top(**OWN, camera_angle_y=1.0), (8, 6, 9.5, 10.5, 3.5, 2.5)),
    (all_frames(**OWN), (8, 6, 9.5, 10.5, 3.5, 2.5)),
    (top(K=K), (8, 6, 9.5, 10.5, 3.5, 2.5)),
    (top(intrinsic_matrix=K), (8, 6, 9.5, 10.5, 3.5, 2.5)),
    (lambda m: (top(fl_x=1.5, cx=7, cy=1, w=8, h=6)(m), all_frames(K=K)(m)), (8, 6, 9.5, 10.5, 3.5, 2.5)),
    (lambda m: (top(fl_x=1.5, fl_y=3, cx=7, cy=1)(m), all_frames(fl_x=9.5)(m)), (8, 6, 9.5, 9.5, 7, 1)),
    (top(fl_x=38, cx=16, cy=12, w=32, h=24), (32, 24, 38, 38, 16, 12)),
])  # fmt: skip
def test_intrinsics_follow_from_what_says_most(root: Path, edit: Edit, expected: tuple) -> None:
    """A frame's own before the file's, matrices before focal lengths before angles; one means square pixels."""
    for found in intrinsics(root, edit):
        assert found == pytest.approx(expected, rel=1e-12)


def test_every_frame_may_have_its_own_camera(root: Path) -> None:
    def edit(manifest: dict[str, Any]) -> None:
        for index, one in enumerate(manifest["frames"]):
            one["K"] = [[FOCAL * (1 + index / 2), 0, 4], [0, FOCAL, 3], [0, 0, 1]]

    assert [found[2] for found in intrinsics(root, edit)] == [FOCAL, 1.5 * FOCAL, 2 * FOCAL, 2.5 * FOCAL]


@pytest.mark.parametrize(("fields", "expected"), [
    ({}, None),
    ({"camera_model": "OPENCV", "k1": 0.0, "p2": 0}, None),
    ({"k1": 0.1, "k2": -0.01, "p1": 0.001, "p2": -0.002}, Distortion("opencv", (0.1, -0.01), (0.001, -0.002))),
    ({"camera_model": "SIMPLE_RADIAL", "k1": 0.1}, Distortion("opencv", (0.1,))),
    ({"camera_model": "opencv", "k3": 0.1}, Distortion("opencv", (0.0, 0.0, 0.1))),
    ({"camera_model": "FULL_OPENCV", "k4": 0.1}, Distortion("opencv", (0.0, 0.0, 0.0, 0.1))),
    ({"is_fisheye": False, "k1": 0.1}, Distortion("opencv", (0.1,))),
    ({"is_fisheye": True}, Distortion("fisheye", (0.0,) * 4)),
    ({"camera_model": "OPENCV_FISHEYE", "k4": 0.01}, Distortion("fisheye", (0.0, 0.0, 0.0, 0.01))),
])  # fmt: skip
def test_lenses_are_opencvs(root: Path, fields: dict, expected: Distortion | None) -> None:
    assert train(read_capture(edited(root, top(**fields))))[0].intrinsics.distortion == expected


def test_a_frames_own_coefficients_come_before_the_files(root: Path) -> None:
    frames = train(read_capture(edited(root, lambda m: (top(k1=0.1, k2=0.01)(m), frame(k1=0.2)(m)))))
    assert [f.intrinsics.distortion.radial for f in frames[:2]] == [(0.1, 0.01), (0.2, 0.01)]  # type: ignore[union-attr]


@pytest.mark.parametrize(("fields", "message"), [
    ({"camera_angle_x": ...}, "camera_angle_x, fl_x or K must be given, got none; add the"),
    ({"camera_angle_x": math.nan}, "camera_angle_x must be a number in .* got nan"),
    ({"camera_angle_x": 39.6}, "camera_angle_x must be in radians, below pi, got 39.6; that may be 0.69115"),
    ({"camera_angle_x": 400}, "camera_angle_x must be a number in .* got 400"),
    ({"fl_x": 0.3}, "fl_x must be in pixels of images 8 across, got 0.3; multiply it by 8 if it is a share"),
    ({"fl_x": -9}, "fl_x must be a number in .* got -9"),
    ({"fl_x": 9, "fl_y": 0}, "fl_y must be a number in .* got 0"),
    ({"cx": 0.5, "cy": 0.5}, "cx: the principal point must be in pixels of images of 8 x 6, got 0.5, 0.5; multip"),
    ({"K": [[9, 0, 0.5], [0, 9, 0.4], [0, 0, 1]]}, "K: the principal point must be in pixels .* got 0.5, 0.4"),
    ({"cx": math.nan}, "cx must be a number in .* got nan"),
    ({"cx": 32, "cy": 24}, "cx and cy lie at 32, 24, far outside of images of 8 x 6; add w and h"),
    ({"w": 8.5, "h": 6}, "w must be a whole number, got 8.5"),
    ({"w": 8, "h": 10**400}, "h must be a number in .* got 1000"),
    ({"K": [[9, 0, 4], [0, 9, 3]]}, "K must be a list of 3 lists of 3 numbers"),
    ({"K": [[9, 1, 4], [0, 9, 3], [0, 0, 1]]}, r"K\[0\]\[1\] must be 0, got 1: pixels without skew"),
    ({"K": [[9, 0, 4], [0, 9, 3], [0, 0, 2]]}, "K must have the rows fx 0 cx, 0 fy cy and 0 0 1"),
    ({"k1": "x"}, "k1 must be a number"),
    ({"camera_model": "EQUIRECTANGULAR"}, "camera_model must be one of PINHOLE, .*; undistort the images"),
    ({"camera_model": 3}, "camera_model must be one of"),
    ({"camera_model": "PINHOLE", "k1": 0.1}, "camera_model must not be PINHOLE with lens coefficients"),
    ({"camera_model": "OPENCV", "k4": 0.1}, "k4 must be 0 with camera_model OPENCV, .*; write FULL_OPENCV"),
    ({"k4": 0.1}, "k4 must be 0 with camera_model OPENCV"),
    ({"camera_model": "OPENCV", "is_fisheye": True}, "is_fisheye must agree with camera_model OPENCV"),
    ({"is_fisheye": "yes"}, "is_fisheye must be true or false, got 'yes'"),
    ({"is_fisheye": True, "p1": 0.1}, "p1 must be 0 of a fisheye lens, got 0.1"),
    ({"k1": -9.0}, r"frames\[0\]: .*lens|distortion"),
])  # fmt: skip
def test_senseless_cameras_are_refused(root: Path, fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        read_capture(edited(root, top(**fields)))
    assert str(caught.value).startswith(str(root / "transforms_train.json"))
    assert "\n" not in str(caught.value)


# Times.


@pytest.mark.parametrize("key", ["time", "timestamp", "frame_number", "frame_id"])
@pytest.mark.parametrize("start", [0, -2.5, 1_700_000_000_000_000_000])
def test_times_are_the_files_own(root: Path, key: str, start: float) -> None:
    def edit(manifest: dict[str, Any]) -> None:
        for index, one in enumerate(manifest["frames"]):
            del one["time"]
            one[key] = start + 1000 * index

    assert [f.time for f in train(read_capture(edited(root, edit)))] == [float(start + 1000 * i) for i in range(4)]


def test_frames_may_have_no_time_but_all_or_none_and_in_all_splits(root: Path) -> None:
    (root / "transforms_test.json").write_text((root / "transforms_train.json").read_text())
    without = all_frames(time=...)
    with pytest.raises(ValueError, match="frames of all splits must have a time, or none; train has none"):
        read_capture(edited(root, without))
    capture = read_capture(edited(root, without, "transforms_test.json"))
    assert {f.time for frames in capture.splits.values() for f in frames} == {None}


# Splits and files.


def test_cameras_of_a_test_split_need_no_images(root: Path) -> None:
    test = edited(root, all_frames(file_path="test/none"))
    (root / "transforms_train.json").rename(root / "transforms_test.json")
    data_folders.write_blender(root)
    capture = read_capture(test)
    assert [f.image for f in capture.splits["test"]] == [None] * NUM_FRAMES
    assert {f.intrinsics for f in capture.splits["test"]} == {train(capture)[0].intrinsics}
    assert capture.notes == ("transforms_test.json: none of its 4 images is there, only cameras are read",)
    assert len({f.name for f in capture.splits["test"]}) == NUM_FRAMES


def test_a_missing_image_stays_named(root: Path) -> None:
    """Whoever decodes images drops a few, or refuses; the size is that of the others."""
    (root / "train/0000.png").unlink()
    first = train(read_capture(root))[0]
    assert first.image is not None
    assert first.image.path == root / "train/0000.png"
    assert first.intrinsics.width == WIDTH
    away = read_capture(edited(root, frame(0, file_path="/away/train/0000.png")))
    assert train(away)[0].image == first.image


def test_planes_background_and_up_are_the_files(root: Path) -> None:
    capture = read_capture(edited(root, top(near=0.5, far=9, background=[0, 0.5, 1], up=[0, 2, 0])))
    assert (capture.planes, capture.background, capture.up) == ((0.5, 9), (0, 0.5, 1), (0, 1, 0))
    capture = read_capture(edited(root, top(far=..., background=..., up=...)))
    assert (capture.planes, capture.background, capture.up) == (None, None, None)
    assert "near and far are used together only" in capture.notes[0]
    (root / "transforms_val.json").write_text((root / "transforms_train.json").read_text())
    edited(root, top(background=[1, 1, 1]), "transforms_val.json")
    with pytest.raises(ValueError, match=r"background must be the same in all files, got .* in transforms_train"):
        read_capture(edited(root, top(background=[0, 0, 0])))


def test_masks_are_found_as_images_are(root: Path) -> None:
    data_folders.write_image(root / "masks/0001.png", 0, 3)
    capture = read_capture(edited(root, frame(mask_path="masks\\0001")))
    assert [f.mask for f in train(capture)] == [None, root / "masks/0001.png", None, None]


def test_nerfstudios_lists_of_names_are_splits(tmp_path: Path) -> None:
    root = data_folders.write_transforms(tmp_path / "scene")
    names = [f"images/{index:04d}.png" for index in range(4)]
    edited(root, top(train_filenames=names[:2], test_filenames=[names[3]]), "transforms.json")
    capture = read_capture(root)
    assert {s: [f.time for f in frames] for s, frames in capture.splits.items()} == {"train": [0, 1], "test": [3]}
    assert capture.notes == ("transforms.json: 1 frames are in none of its lists of file names, they are not used",)
    with pytest.raises(ValueError, match=r"val_filenames must list file_path of frames, got \['x'\]"):
        read_capture(edited(root, top(val_filenames=["x"]), "transforms.json"))


def test_the_same_image_twice_has_two_names(root: Path) -> None:
    capture = read_capture(edited(root, lambda m: m["frames"].append(m["frames"][0])))
    assert [f.name for f in train(capture)] == [f"train/000{i}" for i in range(4)] + ["train/0000#2"]
