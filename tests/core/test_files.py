"""Files appear whole or not at all."""

import json
import math
import os
from pathlib import Path

import pytest

from dnerf.core.files import atomic_path, write_json, write_text


def write_and_fail(path: Path) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError("interrupted")


def test_failed_write_leaves_no_trace(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="interrupted"):
        write_and_fail(tmp_path / "new.txt")
    assert list(tmp_path.iterdir()) == []


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="interrupted"):
        write_and_fail(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_told_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "state.bin"
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*state\.bin'"),
        atomic_path(path),
        Path("/dev/full").open("wb", buffering=0) as full,
    ):
        full.write(b"0")
    assert list(tmp_path.iterdir()) == []


def test_old_file_is_seen_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    with atomic_path(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
        assert temporary.parent == path.parent
        assert temporary.suffix == ".txt"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_missing_folders_are_made(tmp_path: Path) -> None:
    write_text(tmp_path / "a" / "b" / "file.txt", "grüße\n")
    assert (tmp_path / "a" / "b" / "file.txt").read_bytes() == "grüße\n".encode()


def test_files_are_readable_as_the_umask_says(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_text(tmp_path / "file.txt", "text")
        assert os.umask(0o027) == 0o027
    finally:
        os.umask(before)
    assert (tmp_path / "file.txt").stat().st_mode & 0o777 == 0o640


def test_json_reads_back(tmp_path: Path) -> None:
    value = {"psnr": 25.5, "frames": [{"index": 0}], "name": "größe"}
    write_json(tmp_path / "metrics.json", value)
    text = (tmp_path / "metrics.json").read_text(encoding="utf-8")
    assert json.loads(text) == value
    assert text.endswith("}\n")


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_json_without_a_standard_form_is_refused(tmp_path: Path, number: float) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "metrics.json", {"psnr": number})
    assert list(tmp_path.iterdir()) == []
