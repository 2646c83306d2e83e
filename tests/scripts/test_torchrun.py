"""Training under torchrun, as a user starts it on several cores or GPUs."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from launcher import ROOT, run_script
from test_resume import SETTINGS, log_lines, wait_for_step
from test_sweeps import children

from dnerf.training.tensor_files import decode

pytestmark = pytest.mark.slow


def torchrun(cwd: Path, *arguments: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc_per_node=2", "--standalone"]
    command += [str(ROOT / "scripts" / "train.py"), *SETTINGS, "+sampler.pad_to=1", *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def largest_difference(a: Path, b: Path) -> float:
    (one, _), (two, _) = (decode((path / "model.safetensors").read_bytes()) for path in (a, b))
    return max(float((one[name].double() - two[name].double()).abs().max()) for name in one)


def test_two_processes_train_the_model_that_one_does_and_it_continues_with_either(tmp_path: Path) -> None:
    twenty = ("renderer.precision=float32", "trainer.num_steps=20", "trainer.target_samples=null")
    done = torchrun(tmp_path, *twenty, "out_dir=two")
    out, err = done.communicate(timeout=600)
    assert done.returncode == 0, err
    assert out.count("3 frames of 16 x 16") == out.count("box: ") == 1  # one process speaks
    alone = run_script("train", *SETTINGS, "+sampler.pad_to=1", *twenty, "out_dir=one", cwd=tmp_path)
    assert alone.returncode == 0, alone.stderr
    assert {p.name for p in (tmp_path / "two").rglob("*")} == {p.name for p in (tmp_path / "one").rglob("*")}
    # Adam's epsilon of 1e-15 lets rows of the table whose gradient is nothing but rounding move by whole steps; the
    # promise of 1e-6 is for the usual epsilon and is tested in tests/training/test_distributed.py.
    assert abs(log_lines(tmp_path / "two")[-1]["psnr"] - log_lines(tmp_path / "one")[-1]["psnr"]) < 0.1
    more = run_script("train", "resume=true", "out_dir=two", "trainer.num_steps=22", cwd=tmp_path)
    assert more.returncode == 0, more.stderr
    assert "continuing after step 20" in more.stdout


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_or_dead_process_ends_the_job_and_it_continues(tmp_path: Path, number: signal.Signals) -> None:
    job = torchrun(tmp_path, "trainer.num_steps=1000000", "out_dir=run")
    wait_for_step(tmp_path / "run", 10)
    workers = children(job.pid)
    assert len(workers) >= 2
    # SIGTERM to the launcher, which passes it on, as a cluster manager would; SIGKILL to the last process.
    os.kill(job.pid if number == signal.SIGTERM else workers[-1], number)
    begin = time.monotonic()
    _, err = job.communicate(timeout=120)
    assert time.monotonic() - begin < 100
    assert job.returncode != 0
    if number == signal.SIGTERM:
        assert "stopped by SIGTERM after step" in err
    steps = log_lines(tmp_path / "run")[-1]["step"]
    done = torchrun(tmp_path, f"trainer.num_steps={steps + 3}", "out_dir=run", "resume=true")
    out, err = done.communicate(timeout=600)
    assert done.returncode == 0, err
    assert "continuing after step" in out
    assert [line["step"] for line in log_lines(tmp_path / "run")] == list(range(1, steps + 4))


def test_wrong_input_ends_all_processes(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("mine")
    job = torchrun(tmp_path, "trainer.num_steps=2", "out_dir=run")
    _, err = job.communicate(timeout=300)
    assert job.returncode != 0
    assert "error: out_dir: run already holds another run" in err
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["mine.txt"]
