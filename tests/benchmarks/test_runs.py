"""Runs in processes of their own, and what a scene needs, with a stand-in for the training script."""

import json
import sys
from functools import cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from benchmarks import runs
from benchmarks.needs import Trial, last_of_each, removing, smallest_enough
from benchmarks.runs import run_training
from benchmarks.scenes import scene_overrides
from benchmarks.suite import Settings
from benchmarks.training import run as run_training_suite
from dnerf.training.runs import build

BOX = "[[-1.5,-1.5,-1.5],[1.5,1.5,1.5]]"

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
metrics = {"psnr": 20 + seconds + int(values.get("seed", 0)), "ssim": 0.5, "train_seconds": seconds, "num_steps": 10,
           "num_parameters": 7, "seconds_per_frame": 0.25, "split": "test", "frames": []}
(out / "metrics.json").write_text(json.dumps(metrics))
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
    assert [p.name for p in result.plots] == ["training_walker", "training_static"]
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


def trial(psnr):
    return Trial(psnr, 0, 0, 0, 0, 0)


@pytest.mark.parametrize(("together", "removed"), [(29.95, ["b", "a"]), (29.0, ["a"])])
def test_parts_that_are_missed_together_are_put_back_the_most_valuable_first(together, removed):
    without = {"a": trial(30.0), "b": trial(29.95), "c": trial(25.0)}
    tried = []

    def train(names):
        tried.append(names)
        return trial(together)

    names, smallest = smallest_enough(trial(29.92), without, train)
    assert names == removed
    assert smallest.psnr >= 29.9
    assert tried == [["b", "a"]]


@pytest.mark.parametrize("missed_by", [0.0, 0.2, 0.5, 2.5, 6.0, 100.0])
def test_as_few_parts_as_needed_are_put_back_by_few_trainings(missed_by):
    worth = {name: 0.25 * (8 - number) for number, name in enumerate("abcdefgh")}  # a is worth most
    without = {name: trial(0.0) for name in worth}  # and nothing is missed alone
    tried = []

    def train(names):
        tried.append(names)
        return trial(missed_by - sum(worth[name] for name in names))

    names, _ = smallest_enough(trial(0.0), without, train)
    kept = [k for k in range(len(worth)) if missed_by - sum(list(worth.values())[k:]) >= -0.1]
    assert names == list(worth)[min([*kept, len(worth) - 1]) :]
    assert len(tried) <= 3  # log2(8)


def test_what_hinders_does_not_make_other_parts_needed():
    """Without b all is much better; a and c are no more missed for that."""
    without = {"a": trial(20.0), "b": trial(25.0), "c": trial(20.5), "d": trial(18.0)}
    names, smallest = smallest_enough(trial(20.0), without, lambda names: trial(25.0 + len(names)))
    assert names == ["a", "c", "b"]
    assert smallest.psnr == 28
    worse = smallest_enough(trial(20.0), without, lambda names: trial(24.0))
    assert worse == (["b"], without["b"])


def test_all_parts_stay_if_each_is_missed():
    full = trial(30.0)
    assert smallest_enough(full, {"a": trial(20.0)}, lambda names: full) == ([], full)


def test_a_part_that_is_gone_with_another_is_not_removed_twice():
    parts, includes = {"a": ["a=1"], "b": ["a.c=2", "d=3"]}, {"a": ["b"]}
    assert removing(["b", "a"], parts, includes) == ["a=1"]
    assert removing(["b"], parts, includes) == ["a.c=2", "d=3"]


def test_an_override_that_is_replaced_is_not_printed():
    assert last_of_each(["a=1", "b=2", "a=null"]) == ["b=2", "a=null"]


CONF = Path(__file__).parents[2] / "conf"
NEEDS = OmegaConf.to_container(OmegaConf.load(CONF / "benchmark.yaml").needs, resolve=True)


@cache
def composed(*overrides):
    base = [f"experiment={NEEDS['experiment']}", *NEEDS["full"], f"data.box={BOX}"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train", last_of_each([*base, *overrides]))


@pytest.mark.parametrize("names", [*([name] for name in NEEDS["parts"]), list(NEEDS["parts"])], ids=" ".join)
def test_parts_of_the_needs_can_be_removed_alone_and_together(names):
    config = composed(*removing(names, NEEDS["parts"], NEEDS["includes"]))
    assert config != composed()
    plain = OmegaConf.to_container(config, resolve=True)
    renderer = build(plain["renderer"])
    for loss in build(plain["trainer"]["losses"]).values():
        loss.check(renderer)


def test_parts_that_are_gone_with_others_are_parts():
    assert {name for names in NEEDS["includes"].values() for name in names} <= set(NEEDS["parts"])


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
