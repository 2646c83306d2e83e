"""Training that is stopped, continued, refused: the script as a user runs it."""

import json
import os
import shutil
import signal
import time
from pathlib import Path

import pytest
import yaml
from launcher import SMALL_DEMO, Run, run_script

from dnerf.training.tensor_files import decode

SETTINGS = ("trainer.callbacks.checkpoints.every=8", *SMALL_DEMO)
STEPS = 24


def log_lines(run: Path) -> list[dict]:
    path = run / "log.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def wait_for_step(run: Path, step: int) -> None:
    deadline = time.monotonic() + 120
    while not any(line["step"] >= step for line in log_lines(run)):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def train(cwd: Path, *changes: str):
    return run_script("train", *SETTINGS, f"trainer.num_steps={STEPS}", "out_dir=run", *changes, cwd=cwd)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cwd = tmp_path_factory.mktemp("whole")
    done = train(cwd)
    assert done.returncode == 0, done.stderr
    return cwd / "run"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_saves_and_the_run_continues_bit_for_bit(
    tmp_path: Path, whole: Path, number: signal.Signals, code: int
) -> None:
    run = tmp_path / "run"
    endless = Run("train", *SETTINGS, "trainer.num_steps=1000000", "out_dir=run", cwd=tmp_path)
    wait_for_step(run, 2)
    for _ in range(3):  # a terminal and a cluster manager may both say so
        os.kill(endless.pid, number)
    stopped = endless.wait()
    assert stopped.returncode == code, stopped.stderr
    lines = stopped.stderr.strip().splitlines()
    assert len(lines) == 1
    assert f"stopped by {number.name} after step" in lines[0]
    assert "resume=true" in lines[0]
    step = log_lines(run)[-1]["step"]
    assert f"after step {step}," in lines[0]
    assert (run / "checkpoints" / f"step_{step:08d}.safetensors").is_file()
    assert not (run / "model.safetensors").exists()
    if step < STEPS:  # the schedule depends on num_steps, so that only an equal one can give equal weights
        done = run_script("train", "out_dir=run", "resume=true", f"trainer.num_steps={step + 2}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert f"continuing after step {step}" in done.stdout
        assert [line["step"] for line in log_lines(run)] == list(range(1, step + 3))


def test_the_box_is_fitted_once_saved_and_agrees_with_auto(tmp_path: Path, whole: Path) -> None:
    config = yaml.safe_load((whole / "config.yaml").read_text())
    box = config["box"]
    assert config["data"]["box"] == "auto"
    assert all(low < high for low, high in zip(*box))
    places = [config["sampler"]["grid"], config["field"], config["renderer"]["sampler"]["grid"]]
    assert all(place["box"] == box for place in places)
    shutil.copytree(whole, tmp_path / "run")
    for number, named in enumerate(((), ("data.box=auto",), (*SETTINGS, "data.box=auto")), STEPS + 1):
        more = run_script("train", "out_dir=run", "resume=true", *named, f"trainer.num_steps={number}", cwd=tmp_path)
        assert more.returncode == 0, more.stderr
        assert more.stdout.count("box: ") == 1
        assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["box"] == box
    assert [line["step"] for line in log_lines(tmp_path / "run")] == list(range(1, STEPS + 4))
    other = train(tmp_path, "data.box=[[-2,-2,-2],[2,2,2]]", "resume=true")
    assert other.returncode == 2
    assert "data.box must be" in other.stderr


def test_a_box_of_ones_own_is_taken_as_given(tmp_path: Path) -> None:
    done = train(tmp_path, "data.box=[[-2,-2,-2],[2,2,2]]", "trainer.num_steps=2")
    assert done.returncode == 0, done.stderr
    assert "box: [[-2, -2, -2], [2, 2, 2]], as given" in done.stdout


def test_a_finished_run_that_goes_on_is_not_thrown_back(tmp_path: Path, whole: Path) -> None:
    """Rates stay where they ended, and all frames and grid levels stay in, however far the new end is."""
    shutil.copytree(whole, tmp_path / "run")
    last = log_lines(whole)[-1]["learning_rate_factor"]
    assert last < 0.08
    more = run_script("train", "out_dir=run", "resume=true", f"trainer.num_steps={4 * STEPS}", cwd=tmp_path)
    assert more.returncode == 0, more.stderr
    assert all(line["learning_rate_factor"] <= last for line in log_lines(tmp_path / "run")[STEPS:])
    checkpoint = next((tmp_path / "run" / "checkpoints").glob(f"step_*{4 * STEPS}.safetensors"))
    tensors, facts = decode(checkpoint.read_bytes())
    assert facts is not None
    assert facts["progress"] >= 1 - 1 / STEPS
    assert bool((tensors["renderer.field.canonical.window"] == 1).all())


def test_a_stopped_run_ends_with_the_weights_of_an_uninterrupted_one(tmp_path: Path, whole: Path) -> None:
    run = tmp_path / "run"
    started = Run("train", *SETTINGS, f"trainer.num_steps={STEPS}", "out_dir=run", cwd=tmp_path)
    wait_for_step(run, 3)
    os.kill(started.pid, signal.SIGTERM)
    assert started.wait().returncode in (143, 0)
    done = run_script("train", "out_dir=run", "resume=true", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (run / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    assert {p.name for p in run.rglob("*")} == {p.name for p in whole.rglob("*")}


def test_a_finished_run_is_left_as_it_is(whole: Path) -> None:
    before = {path: path.read_bytes() for path in whole.rglob("*") if path.is_file()}
    done = run_script("train", "out_dir=run", "resume=true", cwd=whole.parent)
    assert done.returncode == 0, done.stderr
    assert "nothing to do" in done.stdout
    assert {path: path.read_bytes() for path in whole.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("made", [False, True])
def test_a_run_that_never_began_begins(tmp_path: Path, whole: Path, made: bool) -> None:
    if made:
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / ".tmp-config-x.yaml").write_text("half")
    done = train(tmp_path, "resume=true")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    assert not list((tmp_path / "run").glob(".tmp-*"))


def test_a_start_that_was_refused_is_in_nobodys_way(tmp_path: Path, whole: Path) -> None:
    """Images without alpha want one colour behind them; what was written before that was known is no run."""
    refused = run_script("train", *SETTINGS, "+data.background=white", "background=random", "out_dir=run", cwd=tmp_path)
    assert refused.returncode == 2
    assert "background: a random one needs frames with alpha" in refused.stderr
    for more in ((), ("resume=true",)):
        done = train(tmp_path, *more)
        assert done.returncode == 0, done.stderr
        assert (tmp_path / "run" / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
        given = json.loads((tmp_path / "run" / "overrides.json").read_text())
        assert "background=random" not in given
        shutil.rmtree(tmp_path / "run" / "checkpoints")
        for path in (tmp_path / "run").iterdir():
            if path.name not in ("config.yaml", "overrides.json"):
                path.unlink() if path.is_file() else shutil.rmtree(path)


def test_a_model_that_is_gone_is_written_again(tmp_path: Path, whole: Path) -> None:
    shutil.copytree(whole, tmp_path / "run")
    (tmp_path / "run" / "model.safetensors").unlink()
    done = run_script("train", "out_dir=run", "resume=true", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()


def test_a_model_without_checkpoints_is_not_trained_over(tmp_path: Path, whole: Path) -> None:
    shutil.copytree(whole, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    before = (tmp_path / "run" / "model.safetensors").read_bytes()
    done = run_script("train", "out_dir=run", "resume=true", "trainer.num_steps=1000", cwd=tmp_path)
    assert done.returncode == 2
    assert "holds a model but no checkpoint to continue from" in done.stderr
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("evaluate_split=tets",), "evaluate_split must be one of train, val, test or null, got 'tets'"),
        (("evaluate_frames=0",), "evaluate_frames must be a whole number of at least 1 or null, got 0"),
        (("chunk=1.5",), "chunk must be a whole number of at least 1, got 1.5"),
        (("data.box=[[10,10,10],[11,11,11]]",), "box must be seen by some camera between near 2 and far 6"),
        (("trainer.optimizer.betas=[0.9,2]",), "trainer.optimizer.betas must be two numbers in [0, 1)"),
        (("data_root=elsewhere", "resume=true"), "data_root must be null, this run's frames are of an exact scene"),
        (("data_root=elsewhere",), "data_root must be null unless a run is continued"),
    ],
)
def test_what_would_be_wrong_in_the_end_is_refused_at_the_start(
    tmp_path: Path, whole: Path, arguments: tuple[str, ...], named: str
) -> None:
    if "resume=true" in arguments:
        shutil.copytree(whole, tmp_path / "run")
        done = run_script("train", "out_dir=run", *arguments, cwd=tmp_path)
    else:
        done = train(tmp_path, *arguments)
        assert not (tmp_path / "run").exists()
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert named in done.stderr


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("resume=true", "out_dir=run", "trainer.num_rays=33"), "trainer.num_rays must be 32"),
        (("resume=true", "out_dir=run", "seed=1"), "seed must be 0"),
        (("resume=true", "out_dir=run", *SETTINGS[:-1]), "num_probes must be 1024"),
        (("resume=true",), "needs out_dir"),
        (("out_dir=run", *SETTINGS), "resume=true"),
        (("resume=true", "out_dir=other", *SETTINGS), "other"),
        (("out_dir=lone", *SETTINGS), "lone already holds"),
    ],
)
def test_what_cannot_be_continued_is_refused_in_one_line(whole: Path, arguments: tuple[str, ...], named: str) -> None:
    (whole.parent / "other").mkdir(exist_ok=True)
    (whole.parent / "other" / "thesis.tex").write_text("mine")
    (whole.parent / "lone").mkdir(exist_ok=True)
    (whole.parent / "lone" / "config.yaml").write_text("mine: true")
    before = {path: path.stat().st_mtime_ns for path in whole.parent.rglob("*")}
    done = run_script("train", *arguments, cwd=whole.parent)
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert named in done.stderr
    assert {path: path.stat().st_mtime_ns for path in whole.parent.rglob("*")} == before


def test_a_run_folder_with_links_is_not_written_to(tmp_path: Path, whole: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    shutil.copytree(whole, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    (tmp_path / "run" / "checkpoints").symlink_to(outside)
    done = run_script("train", "out_dir=run", "resume=true", cwd=tmp_path)
    assert done.returncode == 2
    assert "checkpoints is a link" in done.stderr
    assert list(outside.iterdir()) == []


def test_a_run_in_use_is_refused_and_lives_on(tmp_path: Path) -> None:
    first = Run("train", *SETTINGS, "trainer.num_steps=1000000", "out_dir=run", cwd=tmp_path)
    wait_for_step(tmp_path / "run", 1)
    second = run_script("train", "out_dir=run", "resume=true", cwd=tmp_path)
    os.kill(first.pid, signal.SIGTERM)
    assert second.returncode == 2, second.stderr
    assert "in use by another process" in second.stderr
    assert first.wait().returncode == 143


def test_seconds_spent_are_part_of_the_state(tmp_path: Path) -> None:
    # Rates that fall from the first step on: the schedule alone says how much time is spent.
    falling = ("trainer.optimizer.hold_until=0", "trainer.optimizer.warmup_steps=0")
    limited = (*SETTINGS, *falling, "trainer.num_steps=1000000", "trainer.max_seconds=3", "out_dir=run")
    first = Run("train", *limited, cwd=tmp_path)
    wait_for_step(tmp_path / "run", 9)
    os.kill(first.pid, signal.SIGTERM)
    first.wait()
    before = log_lines(tmp_path / "run")[-1]
    done = run_script("train", *limited, "resume=true", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = log_lines(tmp_path / "run")
    seconds = [line["seconds"] for line in lines]
    assert seconds == sorted(seconds)
    after = next(line for line in lines if line["step"] == before["step"] + 1)
    assert before["seconds"] < after["seconds"] < before["seconds"] + 2
    assert 3 <= seconds[-1] < 5
    # The schedule went on too: its factor follows the seconds of both processes together.
    assert after["learning_rate_factor"] <= 0.05 ** (before["seconds"] / 3)
    assert lines[-1]["learning_rate_factor"] < 0.1


def test_other_frames_than_those_the_run_began_with_are_refused(tmp_path: Path) -> None:
    for seed in (0, 1):
        made = run_script(
            "make_dataset", "scene=static", "num_frames=3", "num_val=1", "num_test=1", "resolution=16",
            f"seed={seed}", f"out=data{seed}", cwd=tmp_path,
        )  # fmt: skip
        assert made.returncode == 0, made.stderr
    blender = ("data=blender", "data.resolution=16", "trainer.num_steps=2", "~trainer.callbacks.progress_bar")
    common = ("experiment=fast", *blender, "sampler.grid.resolution=16", "out_dir=run")
    assert run_script("train", *common, "data.root=data0", cwd=tmp_path).returncode == 0
    (tmp_path / "data0").rename(tmp_path / "moved")
    again = (*common, "resume=true")
    done = run_script("train", *again, "data.root=moved", "trainer.num_steps=3", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "continuing after step 2" in done.stdout
    done = run_script("train", *again, "data.root=data1", "trainer.num_steps=4", cwd=tmp_path)
    assert done.returncode == 2
    assert "not those that this run began with" in done.stderr
