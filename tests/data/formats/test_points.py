import json
import struct
import time
from pathlib import Path

import data_folders
import numpy as np
import pytest
from data_folders import POINTS

from dnerf.data.formats import read_capture
from dnerf.data.formats.points import MAX_POINTS, read_ply

HEADER = "ply\nformat {} 1.0\ncomment made by hand\nelement vertex {}\n{}\nend_header\n"
XYZ = "property float x\nproperty float y\nproperty float z"
COLORED = "property uchar red\nproperty double x\nproperty double y\nproperty float quality\nproperty double z"


def ply(form: str, rows: list, properties: str = XYZ, layout: str = "3f") -> bytes:
    head = HEADER.format(form, len(rows), properties).encode()
    if form == "ascii":
        return head + "\n".join(" ".join(str(x) for x in row) for row in rows).encode()
    order = "<" if form == "binary_little_endian" else ">"
    return head + b"".join(struct.pack(order + layout, *row) for row in rows)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_vertices_are_read_whatever_else_they_have(tmp_path: Path, form: str) -> None:
    path = tmp_path / "p.ply"
    path.write_bytes(ply(form, POINTS.tolist()))
    np.testing.assert_allclose(read_ply(path).numpy(), POINTS, rtol=1e-6)  # type: ignore[union-attr]
    rows = [[7, x, y, 0.5, z] for x, y, z in POINTS.tolist()]
    path.write_bytes(ply(form, rows, COLORED, "BddfdB"[:5]))
    np.testing.assert_allclose(read_ply(path).numpy(), POINTS, rtol=1e-6)  # type: ignore[union-attr]


def test_many_points_are_thinned_out_and_those_that_are_not_finite_left_out(tmp_path: Path) -> None:
    path = tmp_path / "p.ply"
    count = 3 * MAX_POINTS + 1
    values = np.arange(3 * count, dtype="<f4").reshape(-1, 3)
    values[0] = np.nan
    path.write_bytes(HEADER.format("binary_little_endian", count, XYZ).encode() + values.tobytes())
    points = read_ply(path)
    assert points is not None
    assert MAX_POINTS // 2 < len(points) <= MAX_POINTS
    assert bool(points.isfinite().all())
    path.write_bytes(ply("ascii", [["nan", 0, 0]]))
    assert read_ply(path) is None


@pytest.mark.parametrize(("content", "message"), [
    (b"", "not a PLY file"),
    (b"ply\n" + b"x" * 100_000, "not a PLY file"),
    (HEADER.format("binary_little_endian", 10**9, XYZ).encode(), "properties|vertices"),
    (HEADER.format("binary_little_endian", 999_999_999, XYZ).encode(), "must hold 999999999 vertices of 12 bytes"),
    (HEADER.format("binary_little_endian", -1, XYZ).encode(), "vertices must be a number of points"),
    (HEADER.format("ascii", 999_999_999, XYZ).encode() + b"1 2 3\n", "line 2 is not"),
    (HEADER.format("zip", 1, XYZ).encode(), "must have a known format"),
    (HEADER.format("ascii", 1, "property list uchar int x").encode(), "must be single numbers"),
    (HEADER.format("ascii", 1, "property float x").encode() + b"1\n", "with x, y and z"),
    (HEADER.format("ascii", 1, XYZ + "\nproperty float x").encode(), "must be single numbers"),
])  # fmt: skip
def test_hostile_files_are_refused_at_once(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "p.ply"
    path.write_bytes(content)
    begin = time.process_time()
    with pytest.raises(ValueError, match=message) as caught:
        read_ply(path)
    assert time.process_time() - begin < 1
    assert "\n" not in str(caught.value)


def test_only_points_that_a_file_names_are_read_and_a_broken_file_is_a_note(tmp_path: Path) -> None:
    """Tools put random points beside data sets, to begin from."""
    root = data_folders.write_transforms(tmp_path / "scene")
    (root / "points3d.ply").write_bytes(ply("ascii", POINTS.tolist()))
    assert read_capture(root).points is None
    fields = json.loads((root / "transforms.json").read_text())
    for name, count in (("points3d.ply", 3), ("none.ply", 0), ("../p.ply", 0), ("images/0000.png", 0)):
        (root / "transforms.json").write_text(json.dumps({**fields, "ply_file_path": name}))
        capture = read_capture(root)
        assert len(capture.points if capture.points is not None else ()) == count
        assert ("sparse points were not read" in "".join(capture.notes)) == (count == 0)
