import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from dnerf.data.formats.old_manifest import MAX_BYTES, read_manifest

Edit = Callable[[dict[str, Any]], object]
Scene = Callable[..., Path]


def frame(**changes: object) -> Edit:
    """Change fields of the second frame; `...` removes one."""

    def edit(manifest: dict[str, Any]) -> None:
        target = manifest["frames"][1]
        for field, value in changes.items():
            if value is ...:
                del target[field]
            else:
                target[field] = value

    return edit


def entry(row: int, column: int, value: object) -> Edit:
    def edit(manifest: dict[str, Any]) -> None:
        manifest["frames"][1]["transform_matrix"][row][column] = value

    return edit


def test_a_good_file_is_read(make_scene: Scene) -> None:
    manifest = read_manifest(make_scene(), "train")
    assert manifest.names == ("train/r_0", "train/r_1", "train/r_2")
    assert [image.name for image in manifest.images] == ["r_0.png", "r_1.png", "r_2.png"]
    assert manifest.times.tolist() == [0, 0.5, 1]
    angle = 1.0
    expected = [[math.cos(angle), -math.sin(angle), 0, 1.5], [math.sin(angle), math.cos(angle), 0, -0.5]]
    torch.testing.assert_close(manifest.poses[1, :2], torch.tensor(expected))
    assert manifest.poses.dtype == manifest.times.dtype == torch.float32


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda m: m.pop("frames"), r"frames must be a list with at least one frame, got None"),
        (lambda m: m.update(frames=[]), r"frames must be a list with at least one frame, got \[\]"),
        (lambda m: m.update(frames={"a": 1}), r"frames must be a list"),
        (lambda m: m["frames"].insert(1, "x"), r"frames\[1\] must be an object, got 'x'"),
        (frame(time=...), r"frames\[1\].time is missing"),
        (frame(time=-0.01), r"frames\[1\].time must be a number in \[0, 1\], got -0.01"),
        (frame(time=1.01), r"frames\[1\].time must be a number in \[0, 1\], got 1.01"),
        (frame(time=math.nan), r"frames\[1\].time must be a number in \[0, 1\], got nan"),
        (frame(time="0.5"), r"frames\[1\].time must be a number in \[0, 1\], got '0.5'"),
        (frame(time=True), r"frames\[1\].time must be a number in \[0, 1\], got True"),
        (frame(time=None), r"frames\[1\].time must be a number in \[0, 1\], got None"),
        (frame(time=10**400), r"frames\[1\].time must be a number in \[0, 1\], got 1000"),
        (frame(transform_matrix=...), r"frames\[1\].transform_matrix is missing"),
        (frame(transform_matrix=[[1, 0], [0, 1]]), r"frames\[1\].transform_matrix must be a list of 4 lists of 4"),
        (frame(transform_matrix=[1, 2, 3, 4]), r"frames\[1\].transform_matrix must be a list of 4 lists of 4"),
        (frame(transform_matrix="eye"), r"frames\[1\].transform_matrix must be a list of 4 lists of 4"),
        (entry(0, 3, math.nan), r"frames\[1\].transform_matrix\[0\]\[3\] must be a number .* got nan"),
        (entry(1, 3, -math.inf), r"frames\[1\].transform_matrix\[1\]\[3\] must be a number .* got -inf"),
        (entry(1, 1, None), r"frames\[1\].transform_matrix\[1\]\[1\] must be a number .* got None"),
        (entry(2, 2, 1.1), r"frames\[1\].transform_matrix must be rigid"),
        (entry(2, 2, -1), r"frames\[1\].transform_matrix must be rigid"),
        (entry(0, 0, 0), r"frames\[1\].transform_matrix must be rigid"),
        (entry(3, 0, 0.5), r"frames\[1\].transform_matrix must be rigid"),
        (entry(3, 3, 2), r"frames\[1\].transform_matrix must be rigid"),
        (frame(file_path=...), r"frames\[1\].file_path is missing"),
        (frame(file_path=3), r"frames\[1\].file_path must be printable text, got 3"),
        (frame(file_path="train/r_1\0"), r"frames\[1\].file_path must be printable text, got 'train/r_1\\x00'"),
        (frame(file_path="train/\nr_1"), r"frames\[1\].file_path must be printable text"),
        (frame(file_path="train/\ud800"), r"frames\[1\].file_path must be printable text"),
        (frame(file_path=""), r"frames\[1\].file_path must stay inside"),
        (frame(file_path="."), r"frames\[1\].file_path must stay inside"),
        (frame(file_path="/etc/passwd"), r"frames\[1\].file_path must stay inside"),
        (frame(file_path="../scene/train/r_1"), r"frames\[1\].file_path must stay inside"),
        (frame(file_path="train/../../scene/train/r_1"), r"frames\[1\].file_path must stay inside"),
        (frame(file_path="C:/train/r_1"), r"frames\[1\].file_path must stay inside"),
        (frame(file_path="train/r_7"), r"frames\[1\].file_path: no image .*train/r_7"),
        (frame(file_path="x" * 5000), r"frames\[1\].file_path: no image"),
        (frame(fl_x=3.0), r"frames\[1\].fl_x must be at the top level"),
    ],
)
def test_bad_fields_are_named_in_one_line(make_scene: Scene, edit: Edit, message: str) -> None:
    root = make_scene(edit)
    with pytest.raises(ValueError, match=message) as caught:
        read_manifest(root, "train")
    assert str(caught.value).startswith(str(root / "transforms_train.json"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "malformed JSON at line 1 column 1"),
        (b'{"frames": [\n  wrong]}', "malformed JSON at line 2 column 3"),
        (b'{"frames": [{"time": 0', "malformed JSON at line 1 column 23"),
        (b"[1, 2]", r"must hold an object, got \[1, 2\]"),
        (b"null", "must hold an object, got None"),
        (b'{"frames": "\xff\xfe"}', "not UTF-8 at byte 12"),
        (b"[" * 100_000, "malformed JSON: nested too deeply"),
        (b'{"a":' * 100_000, "malformed JSON: nested too deeply"),
        (b'{"camera_angle_x": ' + b"1" * 10_000 + b"}", "malformed JSON: Exceeds the limit"),
        (b" " * (MAX_BYTES + 1), "file must be at most 16 MiB"),
    ],
)
def test_malformed_json_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "transforms_train.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_manifest(tmp_path, "train")
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_missing_file_pipe_and_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"transforms_train.json: file does not exist"):
        read_manifest(tmp_path, "train")
    os.mkfifo(tmp_path / "transforms_train.json")
    with pytest.raises(ValueError, match=r"transforms_train.json: file cannot be read: not a regular file"):
        read_manifest(tmp_path, "train")
    (tmp_path / "transforms_val.json").mkdir()
    with pytest.raises(ValueError, match=r"transforms_val.json: file cannot be read: not a regular file"):
        read_manifest(tmp_path, "val")


@pytest.mark.parametrize(
    ("linked", "outside"), [("train", "outside"), ("train/r_1.png", "outside"), ("train/r_1.png", "scene2/r_1.png")]
)
def test_links_out_of_the_folder_are_refused(make_scene: Scene, tmp_path: Path, linked: str, outside: str) -> None:
    """A sibling whose name begins like the folder's is outside, too."""
    root, target = make_scene(), tmp_path / outside
    target.parent.mkdir(exist_ok=True)
    (root / linked).rename(target)
    (root / linked).symlink_to(target)
    with pytest.raises(ValueError, match=r"frames\[.\].file_path must stay inside .*, got a link out of it"):
        read_manifest(root, "train")


def test_links_inside_the_folder_are_followed_but_one_to_itself_is_no_image(make_scene: Scene, tmp_path: Path) -> None:
    root = make_scene()
    (root / "train" / "r_1.png").rename(root / "elsewhere.png")
    (root / "train" / "r_1.png").symlink_to(root / "elsewhere.png")
    (tmp_path / "link").symlink_to(root)
    assert read_manifest(tmp_path / "link", "train").images[1] == tmp_path / "link" / "train" / "r_1.png"
    (root / "train" / "r_1.png").unlink()
    (root / "train" / "r_1.png").symlink_to("r_1.png")
    with pytest.raises(ValueError, match=r"frames\[1\].file_path: no image"):
        read_manifest(root, "train")


@pytest.mark.parametrize("file_path", ["train/r_1", "./train/r_1", "train/r_1.png", "./train//r_1.png"])
def test_file_path_may_have_an_extension_or_not(make_scene: Scene, file_path: str) -> None:
    manifest = read_manifest(make_scene(frame(file_path=file_path)), "train")
    assert manifest.images[1].name == "r_1.png"
    assert manifest.names[1] == "train/r_1"


@pytest.mark.parametrize(("name", "mark"), [("r_0.5", b""), ("été", b"\xef\xbb\xbf")])
def test_a_dot_in_a_name_is_no_extension_and_utf8_names_with_a_byte_order_mark_are_read(
    make_scene: Scene, name: str, mark: bytes
) -> None:
    root = make_scene()
    (root / "train" / "r_1.png").rename(root / "train" / f"{name}.png")
    path = root / "transforms_train.json"
    path.write_bytes(mark + path.read_text().replace("r_1", name).encode())
    assert read_manifest(root, "train").names[1] == f"train/{name}"


def manifest_with(make_scene: Scene, **fields: object) -> Any:
    def edit(manifest: dict[str, Any]) -> None:
        manifest.update(fields)
        for field in [f for f, value in fields.items() if value is ...]:
            del manifest[field]

    return read_manifest(make_scene(edit), "train")


def test_focal_length_follows_from_the_angle(make_scene: Scene) -> None:
    camera = manifest_with(make_scene, camera_angle_x=2 * math.atan(0.5)).intrinsics(8, 6, "corner")
    assert camera.focal_x == pytest.approx(8, rel=1e-12)
    assert camera.focal_y == camera.focal_x
    assert (camera.center_x, camera.center_y, camera.pixel_origin) == (None, None, "corner")


LENS = {"fl_x": 9.5, "fl_y": 10, "cx": 3.5, "cy": 3.25, "w": 8, "h": 6, "k1": 0, "camera_angle_x": 1.0}


@pytest.mark.parametrize(
    ("fields", "expected"),
    [(LENS, (9.5, 10, 3.5, 3.25)), ({"fl_x": 9.5, "camera_angle_x": ...}, (9.5, 9.5, None, None))],
)
def test_focal_lengths_in_pixels_come_before_the_angle(make_scene: Scene, fields: dict, expected: tuple) -> None:
    """`fl_x` alone means square pixels."""
    camera = manifest_with(make_scene, **fields).intrinsics(8, 6, "center")
    assert (camera.focal_x, camera.focal_y, camera.center_x, camera.center_y) == expected


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"camera_angle_x": ...}, "camera_angle_x or fl_x must be given, got neither"),
        ({"camera_angle_x": math.nan}, "camera_angle_x must be a number in .* got nan"),
        ({"camera_angle_x": 0}, "camera_angle_x must be a number in .* got 0"),
        ({"camera_angle_x": 3.15}, "camera_angle_x must be a number in .* got 3.15"),
        ({"camera_angle_x": 5e-324}, "camera_angle_x must be a number in .* got 5e-324"),
        ({"camera_angle_x": "0.7"}, "camera_angle_x must be a number in .* got '0.7'"),
        ({"fl_x": -9}, "fl_x must be a number in .* got -9"),
        ({"fl_x": math.inf}, "fl_x must be a number in .* got inf"),
        ({"fl_x": 9, "fl_y": 0}, "fl_y must be a number in .* got 0"),
        ({"cx": math.nan}, "cx must be a number in .* got nan"),
        ({"cy": 1e300}, "cy must be a number in .* got 1e"),
        ({"w": 9}, "w must be the images' 8, got 9"),
        ({"h": 5}, "h must be the images' 6, got 5"),
        ({"h": 10**400}, "h must be a number in .* got 1000"),
        ({"k1": 0.01}, "k1 must be 0: lens distortion is not supported"),
        ({"p2": [0]}, r"p2 must be a number in .* got \[0\]"),
    ],
)
def test_senseless_cameras_are_refused(make_scene: Scene, fields: dict[str, Any], message: str) -> None:
    manifest = manifest_with(make_scene, **fields)
    with pytest.raises(ValueError, match=message) as caught:
        manifest.intrinsics(8, 6, "center")
    assert str(caught.value).startswith(str(manifest.path))


def test_planes_are_the_given_then_the_files_then_dnerfs(make_scene: Scene) -> None:
    manifest = manifest_with(make_scene, near=0.5)
    assert manifest.planes(None, None) == (0.5, 6.0)
    assert manifest.planes(1.0, 3) == (1.0, 3.0)
    with pytest.raises(ValueError, match="near and far must satisfy"):
        manifest.planes(math.nan, 6.0)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"near": 7}, "near and far must satisfy 0 <= near < far, got 7.0 and 6.0"),
        ({"near": -1}, "near must be a number"),
        ({"far": math.nan}, "far must be a number"),
    ],
)
def test_senseless_planes_are_refused(make_scene: Scene, fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        manifest_with(make_scene, **fields).planes(None, None)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        *(("background", value, "background") for value in ("white", [1, 1], [0, 0, 1.5], [0, 0, None])),
        *(("pixel_origin", value, "must be one of center, corner") for value in ("middle", None, ["center"])),
    ],
)
def test_senseless_backgrounds_and_pixel_origins_are_refused(
    make_scene: Scene, field: str, value: object, message: str
) -> None:
    manifest = manifest_with(make_scene, **{field: value})
    with pytest.raises(ValueError, match=message):
        getattr(manifest, field)()


def test_a_json_of_many_frames_ends_at_the_limit_without_looking_at_images(tmp_path: Path) -> None:
    (tmp_path / "transforms_train.json").write_text(json.dumps({"frames": [{}] * 100_000}))
    with pytest.raises(ValueError, match="frames must be at most 10000, got 100000"):
        read_manifest(tmp_path, "train")
