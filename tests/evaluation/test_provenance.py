import json
import subprocess
from pathlib import Path

import pytest
import torch

from dnerf.evaluation import provenance as module
from dnerf.evaluation.provenance import commit, hardware, provenance

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def forget() -> None:
    commit.cache_clear()
    hardware.cache_clear()


def test_every_fact_is_said_and_ready_for_json() -> None:
    facts = provenance()
    assert facts.keys() == {"hardware", "commit", "version", "torch", "kernels"}
    assert all(facts.values())
    assert facts["torch"] == torch.__version__
    assert json.loads(json.dumps(facts)) == facts


def test_commit_is_the_repositorys() -> None:
    found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip("not run from a repository")
    name = commit().removesuffix("-dirty")
    assert len(name) >= 12
    assert found.stdout.startswith(name)


def test_outside_a_repository_the_commit_is_unknown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(module, "__file__", str(tmp_path / "provenance.py"))
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert commit() == "unknown"
    monkeypatch.setenv("PATH", "")
    commit.cache_clear()
    assert commit() == "unknown"


def test_hardware_counts_the_cores_of_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda pid: {0, 3, 5}, raising=False)
    assert hardware().startswith("3 x ")
    assert hardware().split(" x ")[1]
