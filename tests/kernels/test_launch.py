"""What compiled kernels are kept under on disk."""

import importlib
import shutil
import sys
from pathlib import Path

import numba
import pytest

from dnerf.kernels.cpu import launch

HELPER = "from numba import njit\n\n\n@njit\ndef number():\n    return {}\n"
KERNEL = """
from .helper import number
from .launch import kernel


@kernel(parallel=False)
def get():
    return number()
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package of kernels: one, made of a function in another file."""
    folder = tmp_path / "kernels_of_a_test" / "cpu"
    folder.mkdir(parents=True)
    shutil.copy(launch.__file__, folder)
    (folder / "helper.py").write_text(HELPER.format(1))
    (folder / "kernel.py").write_text(KERNEL)
    monkeypatch.syspath_prepend(tmp_path)
    return folder


def imported_afresh(monkeypatch: pytest.MonkeyPatch):
    """The kernel, as a new process would find it."""
    for name in [name for name in sys.modules if name.startswith("kernels_of_a_test")]:
        monkeypatch.delitem(sys.modules, name)
    importlib.invalidate_caches()
    return importlib.import_module("kernels_of_a_test.cpu.kernel").get


def test_a_kernel_is_compiled_once_and_again_when_a_file_it_is_made_of_changes(package, monkeypatch):
    for number, counter in ((1, "cache_misses"), (1, "cache_hits"), (2, "cache_misses")):
        (package / "helper.py").write_text(HELPER.format(number))
        get = imported_afresh(monkeypatch)
        assert get() == number
        assert sum(getattr(get.stats, counter).values()) == 1


def test_kernels_are_kept_beside_their_files_or_where_numba_is_told_to(package, monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    imported_afresh(monkeypatch)()
    assert list(package.glob("__pycache__/kernels-*/**/*.nbc"))
    assert numba.config.CACHE_DIR == ""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "told"))
    imported_afresh(monkeypatch)()
    assert list(tmp_path.glob("told/kernels-*/**/*.nbc"))
    assert str(tmp_path / "told") == numba.config.CACHE_DIR


def test_a_folder_that_cannot_be_written_is_left_alone(package, monkeypatch, tmp_path):
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(launch.os, "access", lambda path, mode: False)
    imported_afresh(monkeypatch)()
    assert list(tmp_path.glob("home/.cache/dnerf/kernels-*/**/*.nbc"))
    assert not list(package.glob("__pycache__/kernels-*"))
