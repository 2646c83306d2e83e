"""A run that is killed again and again ends as one left alone; `python tests/kill_harness.py` kills 50 times."""

import subprocess
import sys
from pathlib import Path

import pytest

HARNESS = Path(__file__).with_name("kill_harness.py")


@pytest.mark.slow
def test_a_run_killed_five_times_ends_with_the_same_weights() -> None:
    command = [sys.executable, str(HARNESS), "--kills", "5", "--kills-per-run", "5"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "differences between two: none" in done.stdout
    assert "identical, no stray file" in done.stdout
    assert "killed while writing" in done.stdout
    assert done.stdout.strip().endswith("0 failures")
