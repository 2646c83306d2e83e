"""Several processes that train one model: as one process would, and none waits for the dead."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from dnerf.training.distributed import LostProcess, Processes, _SharedDraws


@pytest.fixture(scope="module")
def outcome() -> dict[str, Any]:
    command = [sys.executable, str(Path(__file__).parents[1] / "data_parallel.py")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("model", ["mlp", "grid"])
def test_two_processes_train_as_one_does_and_only_the_first_writes(outcome: dict[str, Any], model: str) -> None:
    result = outcome[model]
    assert result["moved"] > 1e-3
    # Only the order of sums differs; the bound is the promise, 3e-8 is what is seen.
    assert result["difference"] < 1e-6
    assert result["loss_difference"] < 1e-6
    assert result["num_rays_equal"]
    assert result["files_written"] == [2, 0]


def test_occupancy_and_errors_are_the_same_in_all_processes_and_in_one_alone(outcome: dict[str, Any]) -> None:
    result = outcome["grid"]
    assert 0 < result["occupied"][0] < 1  # something was decided
    assert result["occupancy_equal"]
    assert result["processes_equal"]
    assert result["num_rays_vary"]


@pytest.mark.parametrize(("case", "code"), [("killed", -9), ("hanging", 19)])
def test_a_lost_process_ends_the_others_with_an_error(outcome: dict[str, Any], case: str, code: int) -> None:
    result = outcome[case]
    assert result["codes"] == [2, code]
    assert "process 0 of 2 lost another one" in result["said"][0]
    assert "resume=true" in result["said"][0]
    assert result["seconds"] < 60
    assert result["files"] == ["step_00000002.safetensors"]


def test_a_signal_to_one_process_stops_all_with_the_state_saved(outcome: dict[str, Any]) -> None:
    result = outcome["told to stop"]
    assert result["codes"] == [143, 143]
    assert result["files"][-1] >= "step_00000003.safetensors"


@pytest.mark.parametrize("num_rays", [2, 7, 8, 101])
@pytest.mark.parametrize("size", [1, 2, 3])
def test_shares_are_all_rays_once(num_rays: int, size: int) -> None:
    shares = [list(range(num_rays))[Processes(rank, size).share(num_rays)] for rank in range(size)]
    assert [ray for share in shares for ray in share] == list(range(num_rays))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def draw(generator: torch.Generator, count: int) -> list[torch.Tensor]:
    return [
        torch.rand(count, 3, generator=generator),
        torch.rand((count, 2), generator=generator),
        torch.empty(count).uniform_(2, 3, generator=generator),
        torch.randn(count, generator=generator, dtype=torch.float64),
        torch.rand(5),  # not the run's: left alone
    ]


def test_the_draws_of_shares_are_those_of_one_process() -> None:
    alone, parts = torch.Generator().manual_seed(3), []
    whole = draw(alone, 7)
    for rank in range(3):
        share, own = Processes(rank, 3).share(7), torch.Generator().manual_seed(3)
        with _SharedDraws(own, share, 7):
            parts.append(draw(own, share.stop - share.start))
        assert torch.equal(own.get_state(), alone.get_state())
    for index in range(4):
        assert torch.equal(whole[index], torch.cat([part[index] for part in parts]))


def test_draws_that_are_not_one_row_per_ray_are_refused() -> None:
    generator = torch.Generator()
    with _SharedDraws(generator, slice(0, 3), 7):
        with pytest.raises(ValueError, match="one row per ray, 3, got 4"):
            torch.rand(4, generator=generator)
        with pytest.raises(NotImplementedError, match="randperm"):
            torch.randperm(3, generator=generator)


def test_one_process_alone_needs_no_communication(tmp_path: Path) -> None:
    alone = Processes()
    module = torch.nn.Linear(1, 1)
    assert alone.wrap(module) is module  # type: ignore[arg-type]
    assert alone.agree(1.5, 7, 0) == (1.5, 7, 0)
    assert alone.mean({"loss": 2.0}) == {"loss": 2.0}
    assert alone.from_first(lambda: b"data") == b"data"
    alone.merge_observations(module)
    with pytest.raises(RuntimeError, match=r"^gloo$"), alone.watched():
        raise RuntimeError("gloo")


@pytest.mark.parametrize("said", ["Application timeout caused pair closure", "[gloo/x.cc:1] Connection reset by peer"])
def test_what_the_network_says_is_put_plainly(said: str) -> None:
    with pytest.raises(LostProcess, match="died or hangs"), Processes(0, 2).watched():
        raise RuntimeError(said)
    with pytest.raises(RuntimeError, match=r"^shapes do not fit$"), Processes(0, 2).watched():
        raise RuntimeError("shapes do not fit")
