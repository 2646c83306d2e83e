"""Nothing mixes tensors of the CPU with those of another device: what a GPU would refuse shows itself without one."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from other_device import is_possible

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not is_possible, reason="this torch cannot pretend devices")]


@pytest.fixture(scope="module")
def outcome() -> dict[str, Any]:
    program = Path(__file__).with_name("on_other_device.py")
    done = subprocess.run([sys.executable, str(program)], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    return {**json.loads(done.stdout), "said": done.stderr}


def test_training_scores_films_and_motion_work_elsewhere(outcome: dict[str, Any]) -> None:
    scripts = ("train", "resume", "evaluate", "render", "motion")
    expected = {"fast": {"train": 0}, "flow_gpu": dict.fromkeys(scripts, 0)}
    assert outcome["codes"] == expected, outcome["said"]
    assert "on elsewhere:0" in outcome["said"]


def test_mixing_is_refused(outcome: dict[str, Any]) -> None:
    assert outcome["is_mixing_refused"]
