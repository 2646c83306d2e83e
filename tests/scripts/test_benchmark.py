"""The benchmark script: one suite or all of them, each with the command that repeats it."""

import sys

import benchmark
import pytest
from omegaconf import OmegaConf

from benchmarks import SuiteResult, Table

pytest.importorskip("matplotlib")


@pytest.fixture
def config(monkeypatch, tmp_path):
    def run_suite(name, settings):
        return SuiteResult(name, "", [Table("Rows", [{"value": settings.options.get("size")}])])

    monkeypatch.setattr(benchmark, "run_suite", run_suite)
    monkeypatch.setattr(benchmark, "suite_names", lambda: ["one", "two"])
    monkeypatch.setattr(sys, "argv", ["benchmark.py", "suite=all", "seed=3", f"out_dir={tmp_path}"])
    return OmegaConf.create(
        {
            "suite": "all", "quick": False, "seed": 3, "threads": None, "device": "cpu", "out_dir": str(tmp_path),
            "data_root": None, "two": {"size": 7},
        }
    )  # fmt: skip


def test_all_suites_write_a_folder_each_with_their_own_command(config, tmp_path, capsys):
    benchmark.main(config)
    for name in ("one", "two"):
        text = (tmp_path / name / "report.md").read_text()
        assert f"python scripts/benchmark.py suite={name} seed=3 out_dir={tmp_path / name}\n" in text
    assert (tmp_path / "two" / "rows.csv").read_text() == "value\n7\n"
    assert capsys.readouterr().out.count("report: ") == 2


def test_one_suite_writes_into_the_folder_itself(config, tmp_path):
    config.suite = "one"
    benchmark.main(config)
    assert (tmp_path / "report.md").is_file()
    assert not (tmp_path / "one").exists()
