"""Sweeps: jobs that fail, are killed or interrupted leave the others and their own results alone."""

import csv
import os
import signal
import time
from pathlib import Path

import pytest
import sweeps
from launcher import SMALL_DEMO, Run, run_script

pytestmark = pytest.mark.slow

SETTINGS = (*SMALL_DEMO, "trainer.callbacks.checkpoints.every=5", "out_dir=sweep")


def sweep(cwd: Path, *changes: str):
    return run_script("train", "--multirun", *SETTINGS, "trainer.num_steps=3", *changes, cwd=cwd)


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "table.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def half_failed(tmp_path_factory: pytest.TempPathFactory):
    """A sweep of 2 x 2 runs, of which those whose window ends too late fail while they are built."""
    cwd = tmp_path_factory.mktemp("sweep")
    return cwd, sweep(cwd, "field.window_end=2,0.5", "seed=0,1")


def test_a_failed_job_leaves_the_others_alone(half_failed) -> None:
    cwd, done = half_failed
    assert done.returncode == 2, done.stderr
    assert sorted(p.parent.name for p in (cwd / "sweep").glob("*/metrics.json")) == [
        "field.window_end-0.5_seed-0",
        "field.window_end-0.5_seed-1",
    ]
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 3, done.stderr
    assert all(line.startswith("error: ") for line in lines)
    assert "renderer.field.canonical.window_end must be in (0, 1]" in lines[0]
    assert "2 of the sweep's jobs failed: field.window_end-2_seed-0; field.window_end-2_seed-1" in lines[2]


def test_a_sweep_ends_in_one_table(half_failed) -> None:
    cwd, done = half_failed
    found = rows(cwd / "sweep")
    assert [(row["run"], row["status"]) for row in found] == [
        ("field.window_end-0.5_seed-0", "done"),
        ("field.window_end-0.5_seed-1", "done"),
        ("field.window_end-2_seed-0", "failed"),
        ("field.window_end-2_seed-1", "failed"),
    ]
    assert all(float(row["psnr"]) > 0 for row in found[:2])
    assert "seed" in done.stdout
    assert "sd" in done.stdout  # the mean over seeds
    reason = (cwd / "sweep" / "errors" / "field.window_end-2_seed-1.txt").read_text()
    assert "Traceback" in reason
    assert "window_end must be in" in reason


def test_a_finished_sweep_is_continued_without_running_anything_again(half_failed) -> None:
    cwd, _ = half_failed
    before = {path: path.read_bytes() for path in (cwd / "sweep").glob("*-0.5*/*") if path.is_file()}
    assert before
    done = sweep(cwd, "field.window_end=0.5", "seed=0,1,2", "resume=true")
    assert done.returncode == 0, done.stderr
    # Named by what this sweep varies: other folders, new runs.
    assert {p.parent.name for p in (cwd / "sweep").glob("*/metrics.json")} >= {"seed-0", "seed-1", "seed-2"}
    done = sweep(cwd, "field.window_end=0.25,0.5", "seed=0,1", "resume=true")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("nothing to do") == 2
    assert {path: path.read_bytes() for path in (cwd / "sweep").glob("*-0.5*/*") if path.is_file()} == before
    # A single one, alone.
    done = run_script(
        "train", *SETTINGS[:-1], "out_dir=sweep/field.window_end-0.5_seed-1", "resume=true", "field.window_end=0.5",
        "seed=1", "trainer.num_steps=4", cwd=cwd,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "continuing after step 3" in done.stdout


def test_a_wrong_choice_stops_a_sweep_before_it_begins(tmp_path: Path) -> None:
    done = sweep(tmp_path, "background=black,nosuch")
    assert done.returncode == 2
    assert "background/nosuch" in done.stderr
    assert not list(tmp_path.glob("sweep/*/config.yaml"))


def wait_for_logs(folder: Path, count: int) -> None:
    deadline = time.monotonic() + 200
    while len(list(folder.glob("*/log.jsonl"))) < count:
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_a_sweep_with_its_job_saved(tmp_path: Path, number: signal.Signals, code: int) -> None:
    started = Run("train", "--multirun", *SETTINGS, "trainer.num_steps=1000000", "seed=0,1", cwd=tmp_path)
    wait_for_logs(tmp_path / "sweep", 1)
    os.kill(started.pid, number)
    stopped = started.wait()
    assert stopped.returncode == code, stopped.stderr
    assert f"stopped by {number.name}" in stopped.stderr
    assert [p.name for p in (tmp_path / "sweep").glob("seed-*")] == ["seed-0"]
    assert list((tmp_path / "sweep" / "seed-0" / "checkpoints").glob("step_*.safetensors"))


@pytest.mark.slow
def test_ctrl_c_reaches_the_workers_of_joblib_and_everything_continues(tmp_path: Path) -> None:
    common = ("train", "--multirun", *SETTINGS, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=0,1")
    started = Run(*common, "trainer.num_steps=1000000", cwd=tmp_path)
    wait_for_logs(tmp_path / "sweep", 2)
    os.killpg(started.pid, signal.SIGINT)  # what a terminal does
    begin = time.monotonic()
    stopped = started.wait()
    assert time.monotonic() - begin < 60
    assert stopped.returncode == 130, (stopped.returncode, stopped.stderr)
    done = run_script(*common, "trainer.num_steps=12", "resume=true", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [row["status"] for row in rows(tmp_path / "sweep")] == ["done", "done"]


def children(pid: int) -> list[int]:
    """Processes that descend from one."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found += [int(stat.parent.name), *children(int(stat.parent.name))]
    return found


@pytest.mark.slow
def test_a_killed_worker_of_joblib_ends_the_sweep_with_an_error_and_nothing_lost(tmp_path: Path) -> None:
    common = ("train", "--multirun", *SETTINGS, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=0,1")
    started = Run(*common, "trainer.num_steps=1000000", cwd=tmp_path)
    wait_for_logs(tmp_path / "sweep", 2)
    holders = [pid for pid in children(started.pid) if "sweep/seed-" in open_folders(pid)]
    assert len(holders) == 2
    os.kill(holders[0], signal.SIGKILL)
    begin = time.monotonic()
    ended = started.wait()
    assert time.monotonic() - begin < 60
    assert ended.returncode == 2, ended.stderr
    assert "worker of the sweep was killed" in ended.stderr
    done = run_script(*common, "trainer.num_steps=12", "resume=true", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [row["status"] for row in rows(tmp_path / "sweep")] == ["done", "done"]


@pytest.mark.slow
def test_submitit_runs_each_job_in_its_own_process(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    arguments = ("hydra/launcher=submitit_local", "hydra.launcher.timeout_min=5", "seed=0,1", "field.window_end=2,0.5")
    done = sweep(tmp_path, *arguments)
    assert done.returncode == 2, done.stderr
    found = {row["run"]: row["status"] for row in rows(tmp_path / "sweep")}
    assert found == {
        "field.window_end-2_seed-0": "failed",
        "field.window_end-0.5_seed-0": "done",
        "field.window_end-2_seed-1": "failed",
        "field.window_end-0.5_seed-1": "done",
    }
    assert "2 of the sweep's jobs failed" in done.stderr


def open_folders(pid: int) -> str:
    """Targets of a process's file descriptors, joined: a run holds its folder open."""
    names = []
    for descriptor in Path(f"/proc/{pid}/fd").glob("*"):
        try:
            names.append(os.readlink(descriptor))
        except OSError:
            continue
    return "\n".join(names)


def test_table_shows_what_varies_and_means_over_seeds() -> None:
    def row(scene: str, seed: int, psnr: float | None, status: str = "done") -> dict:
        overrides = {"scene": scene, "seed": str(seed), "chunk": "5", "out_dir": f"x{seed}"}
        return {"run": f"{scene}{seed}", "overrides": overrides, "status": status, "num_steps": 10, "psnr": psnr,
                "train_seconds": 1.25, "ssim": None}  # fmt: skip

    walkers = [row("walker", 0, 20.0), row("walker", 1, 22.0)]
    text = sweeps.table([*walkers, row("static", 0, 30.0), row("static", 1, None, "failed")])
    lines = [line.split() for line in text.splitlines()]
    assert lines[0] == ["scene", "seed", "status", "num_steps", "train_seconds", "psnr", "ssim"]
    assert lines[1] == ["walker", "0", "done", "10", "1.250", "20.000"]
    assert ["walker", "2", "21.000", "1.414"] in lines
    assert ["static", "1", "30.000"] in lines
