"""From frames and cameras to a data set; COLMAP's part is played by models of known cameras."""

import builtins
import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from dnerf.capturing import StructureSettings, capture, find_films, structure
from dnerf.core.cameras import look_at
from dnerf.data import FolderData
from dnerf.data.formats import read_capture
from dnerf.visualization import write_frames

DATA_SET = "dnerf.capturing.data_set"
FOCAL, K1 = 60.0, -0.05


def poses(count: int) -> torch.Tensor:
    angles = [0.3 * index for index in range(count)]
    return torch.stack([look_at((3 * math.cos(a), 3 * math.sin(a), 1 + 0.1 * a)) for a in angles])


class KnownModel:
    """A COLMAP model of cameras at `poses`, of the given images."""

    def __init__(self, names: list[str], error: float = 0.5) -> None:
        self.names, self.error = names, error
        tracks = [(3, 0.5), (2, 0.5), (5, 9.0), (4, 1.0)]  # the second is short, the third off
        self.points3D = {
            index: SimpleNamespace(track=SimpleNamespace(length=lambda n=n: n), error=e)
            for index, (n, e) in enumerate(tracks)
        }

    def num_reg_images(self) -> int:
        return len(self.names)

    def compute_mean_reprojection_error(self) -> float:
        return self.error

    def num_points3D(self) -> int:
        return len(self.points3D)

    def delete_point3D(self, number: int) -> None:
        del self.points3D[number]

    def write(self, folder: Path) -> None:
        (folder / "cameras.txt").write_text(f"1 OPENCV 64 48 {FOCAL} {FOCAL} 32 24 {K1} 0 0 0\n")
        lines = []
        for index, (name, pose) in enumerate(zip(self.names, poses(len(self.names)))):
            to_camera = torch.linalg.inv(pose.double() @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double()))
            x, y, z, w = rotation_quaternion(to_camera[:3, :3].numpy())
            lines.append(f"{index + 1} {w} {x} {y} {z} {' '.join(map(str, to_camera[:3, 3].tolist()))} 1 {name}\n\n")
        (folder / "images.txt").write_text("".join(lines))

    def export_PLY(self, path: Path) -> None:
        header = f"ply\nformat ascii 1.0\nelement vertex {len(self.points3D)}\n"
        rows = "".join(f"{index} 0 0.5\n" for index in self.points3D)
        path.write_text(header + "property float x\nproperty float y\nproperty float z\nend_header\n" + rows)


def rotation_quaternion(matrix: np.ndarray) -> np.ndarray:
    """x, y, z, w: the eigenvector of Bar-Itzhack's symmetric matrix."""
    m = matrix
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    return np.linalg.eigh(k)[1][:, -1]


@pytest.fixture
def film(tmp_path: Path) -> Path:
    generator = np.random.default_rng(0)
    images = [generator.integers(0, 256, (48, 64, 3), dtype=np.uint8) for _ in range(20)]
    return write_frames(images, tmp_path / "film.mp4", fps=5)


@pytest.fixture
def placing(monkeypatch):
    """Have models of so many frames be found; the number of times that was done is counted."""
    calls = []
    monkeypatch.setattr(f"{DATA_SET}.load_pycolmap", lambda: None)

    def place(*counts: int, error: float = 0.5) -> list:
        def find(frames, images, work, settings, *, is_ordered):
            calls.append(settings)
            names, models = [frame.name for frame in frames], []
            for count in counts:
                models.append(KnownModel(names[:count], error))
                names = names[count:]
            return models

        monkeypatch.setattr(f"{DATA_SET}.find_structure", find)
        return calls

    return place


def test_a_film_becomes_a_data_set_with_its_cameras_times_and_points(tmp_path: Path, film: Path, placing) -> None:
    placing(9)
    report = capture(tmp_path / "out", find_films(film), num_frames=10)
    read = read_capture(tmp_path / "out")
    assert read.format == "transforms"
    frames = read.splits["all"]
    torch.testing.assert_close(torch.tensor([f.pose for f in frames]), poses(9), rtol=0, atol=1e-5)
    chosen = [int(Path(frame.name).name) for frame in frames]
    assert [frame.time for frame in frames] == pytest.approx([index / 5 for index in chosen])
    assert {(f.intrinsics.focal_x, f.intrinsics.distortion.coefficients[0]) for f in frames} == {(FOCAL, K1)}
    assert read.points.tolist() == [[0, 0, 0.5], [3, 0, 0.5]]
    assert all("could be read" in note for note in read.notes)  # as COLMAP's, whose model is there, too
    assert len(FolderData(tmp_path / "out").frames("train")) == 8  # of nine: one is held out
    assert report[0] == "frames placed: 9 of 10 (90%)"
    assert any("0.50 pixels" in line for line in report)
    assert "could not be placed are left out; film in one take" in report[-1]


def test_the_largest_of_several_pieces_is_taken_and_said(tmp_path: Path, film: Path, placing) -> None:
    placing(7, 3, error=2.0)
    report = capture(tmp_path / "out", find_films(film), num_frames=10)
    assert "left out (pieces of 7, 3)" in report[-2]
    assert "the error is large" in report[-1]
    assert len(read_capture(tmp_path / "out").splits["all"]) == 7


def test_a_third_of_the_frames_is_refused_and_leaves_no_data_set(tmp_path: Path, film: Path, placing) -> None:
    placing(3, 2)
    with pytest.raises(ValueError, match=r"only 3 of 9 frames .* pieces of 3, 2 .* min_share=0.33"):
        capture(tmp_path / "out", find_films(film), num_frames=9)
    assert not (tmp_path / "out" / "transforms.json").exists()
    assert not (tmp_path / "out" / "sparse").exists()
    capture(tmp_path / "out", find_films(film), num_frames=9, min_share=0.33)
    assert len(read_capture(tmp_path / "out").splits["all"]) == 3


def test_a_run_that_was_killed_goes_on_with_the_frames_it_had(tmp_path: Path, film: Path, placing, monkeypatch) -> None:
    calls = placing(10)

    def killed(*_args, **_settings):
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(f"{DATA_SET}.find_structure", killed)
        with pytest.raises(KeyboardInterrupt):
            capture(tmp_path / "out", find_films(film), num_frames=10)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "images").iterdir()}
    capture(tmp_path / "out", find_films(film), num_frames=10)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "images").iterdir()} == before
    assert len(calls) == 1
    first = capture(tmp_path / "out", find_films(film), num_frames=10)
    assert len(calls) == 1  # a run that has ended is only reported
    assert first[0] == "frames placed: 10 of 10 (100%)"
    capture(tmp_path / "out", find_films(film), StructureSettings("SIMPLE_RADIAL"), num_frames=10)
    assert len(calls) == 2


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path, film: Path, placing) -> None:
    placing(10)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("all I have")
    with pytest.raises(ValueError, match="out holds something else"):
        capture(tmp_path / "out", find_films(film))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.txt"]
    capture(tmp_path / "other", find_films(film), num_frames=10)
    with pytest.raises(ValueError, match="other holds something else, or of other settings"):
        capture(tmp_path / "other", find_films(film), num_frames=11)


@pytest.mark.parametrize(("settings", "said"), [
    ({"num_frames": 2}, "num_frames must be at least 3, got 2"),
    ({"num_frames": 0}, "num_frames must be"),
    ({"min_share": 2}, r"min_share must be in \[0, 1\]"),
    ({"model": Path("sparse")}, "model needs images=folder"),
])  # fmt: skip
def test_impossible_settings_are_refused(tmp_path: Path, film: Path, placing, settings, said: str) -> None:
    placing(10)
    with pytest.raises(ValueError, match=said):
        capture(tmp_path / "out", find_films(film), **settings)


def test_without_pycolmap_it_is_said_how_to_install_it(tmp_path: Path, film: Path, monkeypatch) -> None:
    original = builtins.__import__

    def missing(name, *args, **settings):
        if name == "pycolmap":
            raise ImportError("No module named 'pycolmap'")
        return original(name, *args, **settings)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ValueError, match=r"pip install -e '.\[capture\]'"):
        capture(tmp_path / "out", find_films(film))
    assert not (tmp_path / "out").exists()


def test_masks_must_be_of_each_frame_and_its_size(tmp_path: Path) -> None:
    frames = [SimpleNamespace(name=f"{index:05d}.png", size=(64, 48)) for index in range(2)]
    for index, size in enumerate([(48, 64), (48, 64)]):
        mask = np.zeros(size, np.uint8)
        mask[:, 32:] = 255
        Image.fromarray(mask).save(tmp_path / f"{index:05d}.png")
    written = structure._masks(frames, tmp_path / "work", tmp_path)
    np.testing.assert_array_equal(np.asarray(Image.open(written / "00001.png.png")), mask)
    Image.fromarray(mask[:30]).save(tmp_path / "00001.png")
    with pytest.raises(ValueError, match=r"00001.png: mask must be 64 x 48"):
        structure._masks(frames, tmp_path / "work", tmp_path)
    (tmp_path / "00001.png").unlink()
    with pytest.raises(ValueError, match=r"a mask for each frame, 00001.png is missing"):
        structure._masks(frames, tmp_path / "work", tmp_path)


def test_what_a_folder_says_of_itself_is_plain_json(tmp_path: Path, film: Path, placing) -> None:
    placing(10)
    capture(tmp_path / "out", find_films(film), num_frames=10)
    said = json.loads((tmp_path / "out" / "capture.json").read_text())
    assert said["structure"]["result"] == {"parts": [10], "frames": 10, "error": 0.5, "points": 2}
