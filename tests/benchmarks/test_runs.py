"""Runs in processes of their own, and what a scene needs, with a stand-in for the training script."""

import json
import sys

import pytest

from benchmarks import runs
from benchmarks.needs import run as run_needs_suite
from benchmarks.runs import run_training
from benchmarks.scenes import scene_overrides
from benchmarks.suite import Settings
from benchmarks.training import run as run_training_suite

SCRIPT = """
import json, sys
from pathlib import Path
values = dict(word.split("=", 1) for word in sys.argv[1:])
if values.get("fail"):
    sys.exit("error: the reason")
ballast = bytearray(int(values.get("mib", 0)) << 20)
ballast[::4096] = b"x" * len(ballast[::4096])
out = Path(values["out_dir"])
out.mkdir(parents=True)
seconds = float(values.get("trainer.max_seconds", 1))
choices = {"first": values.get("plan.first", "a"), "second": values.get("plan.second", "c")}
psnr = 20 + 2 * (choices["first"] == "b") + seconds + int(values.get("seed", 0))
metrics = {"psnr": psnr, "ssim": 0.5, "train_seconds": seconds, "num_steps": 10,
           "num_parameters": 7, "seconds_per_frame": 0.25, "split": "test", "frames": []}
(out / "metrics.json").write_text(json.dumps(metrics))
plan = {"data": "", "parts": {k: {"choice": v, "by": "trial", "seconds": 1.5} for k, v in choices.items()}}
(out / "plan.yaml").write_text(json.dumps(plan))
(out / "model.safetensors").write_bytes(bytes(1 << 18))
with open(out.parent / "calls.txt", "a") as file:
    file.write(" ".join(sys.argv[1:]) + chr(10))
"""


@pytest.fixture
def command(tmp_path):
    path = tmp_path / "train.py"
    path.write_text(SCRIPT)
    return [sys.executable, str(path)]


def test_memory_is_that_of_this_child_alone(command, tmp_path):
    large = run_training(command, ["mib=200"], tmp_path / "large")
    small = run_training(command, ["mib=0"], tmp_path / "small")
    # The ballast, to the few MiB that interpreters differ by.
    assert large.peak_mib - small.peak_mib == pytest.approx(200, abs=10)
    assert small.psnr == 21
    assert small.step_ms == 100
    assert small.model_mib == 0.25


def test_a_run_of_the_same_clean_commit_is_not_repeated(command, tmp_path, monkeypatch):
    for commit, expected in (("abc", 1), ("abc", 1), ("def", 2), ("def-dirty", 3), ("def-dirty", 4)):
        monkeypatch.setattr(runs, "commit", lambda commit=commit: commit)
        assert run_training(command, ["seed=2"], tmp_path / "run").psnr == 23
        assert len((tmp_path / "calls.txt").read_text().splitlines()) == expected


def test_a_failed_run_is_told_with_its_reason(command, tmp_path):
    with pytest.raises(ValueError, match=r"failed with exit code 1: error: the reason \(log: .*x.log\)"):
        run_training(command, ["fail=1"], tmp_path / "x")


def test_training_suite_averages_over_seeds(command, tmp_path):
    options = {
        "scenes": ["walker", "static"], "experiments": ["fast", "dnerf"], "seconds": [4, 8], "seeds": [0, 2],
        "resolution": 50, "frames": {"dnerf": 2}, "splits": {"static": "val"}, "data_root": None,
        "overrides": {"dnerf": ["trainer.num_rays=64"], "flow": ["seed=9"]},
    }  # fmt: skip
    result = run_training_suite(Settings(work_dir=tmp_path / "work", train_command=command, options=options))
    means = result.tables[0].rows
    assert len(means) == 8
    row = next(r for r in means if (r["scene"], r["experiment"], r["budget_s"]) == ("static", "dnerf", 8))
    assert (row["psnr"], row["psnr_low"], row["psnr_high"], row["split"], row["frames"]) == (29, 28, 30, "val", 2)
    assert (row["resolution"], row["model_MiB"]) == (50, 0.25)
    (plot,) = result.plots
    assert [(series.label, series.color) for series in plot.series][:2] == [("walker, fast", 0), ("static, fast", 1)]
    calls = (tmp_path / "work" / "calls.txt").read_text().splitlines()
    assert len(calls) == 17
    assert "trainer.num_steps=20 " in calls[0]
    assert not (tmp_path / "work" / "warm_up").exists()
    once = Settings(work_dir=tmp_path / "once", train_command=command, options={**options, "seconds": [4]})
    assert run_training_suite(once).plots == []  # a single budget makes no curve
    wanted = ("experiment=dnerf", "scene=static", "data.resolution=50", "evaluate_split=val", "evaluate_frames=2")
    assert all(word in calls[-1].split() for word in wanted)
    with_few_rays = [call for call in calls if "trainer.num_rays=64" in call.split()]
    assert len(with_few_rays) == 8
    assert all("experiment=dnerf" in call.split() for call in with_few_rays)
    assert "`dnerf` runs with `trainer.num_rays=64`" in result.summary
    assert "flow" not in result.summary


def test_needs_suite_says_which_decisions_were_right_wrong_or_open(command, tmp_path):
    """The stand-in scores 2 dB more with `b`, though it chose `a`; `d` makes no difference."""
    parts = {"first": {"candidates": {"a": [], "b": []}}, "second": {"candidates": {"c": [], "d": []}}}
    options = {
        "scenes": ["walker"], "seconds": 4, "seeds": [0, 2], "resolution": 50, "frames": None, "overrides": [],
        "splits": {}, "data_root": None, "parts": parts,
    }  # fmt: skip
    result = run_needs_suite(Settings(work_dir=tmp_path / "work", train_command=command, options=options))
    rows = {row["part"]: row for row in result.tables[0].rows}
    assert (rows["first"]["choice"], rows["first"]["other"], rows["first"]["verdict"]) == ("a", "b", "wrong")
    assert rows["first"]["worth_dB"] == pytest.approx(-2)
    assert (rows["second"]["worth_dB"], rows["second"]["verdict"], rows["second"]["seeds"]) == (0, "open", 2)
    assert rows["second"]["by"] == "trial"
    assert any("2.00 dB more" in finding for finding in result.findings)


def test_scenes_are_exact_ones_or_folders(tmp_path):
    assert scene_overrides("walker", 80, None) == ["data=synthetic", "scene=walker", "data.resolution=80"]
    (tmp_path / "lego").mkdir()
    assert f"data.root={tmp_path / 'lego'}" in scene_overrides("lego", 80, str(tmp_path))
    with pytest.raises(ValueError, match="or a folder below data_root"):
        scene_overrides("lego", 80, None)


def test_memory_table_is_written_as_json(command, tmp_path):
    run_training(command, [], tmp_path / "run")
    saved = json.loads((tmp_path / "run" / runs.KEPT).read_text())
    assert saved["run"]["num_parameters"] == 7
