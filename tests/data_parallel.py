"""Train with several forked processes and with one, and say how far the results are apart, as JSON.

    python tests/data_parallel.py [--processes 2] [--steps 20]

Started by the tests in a process of its own, since processes that have begun threads must not fork.
"""

import argparse
import json
import os
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from preload import load_everything
from test_body_search import a_renderer, frames_of_two_balls, wrong_where_matter_is
from torch import Tensor

from dnerf.backgrounds import RandomBackground
from dnerf.body_search import BodySearch
from dnerf.compositing import Rendering
from dnerf.data import Frames, SyntheticData
from dnerf.deformations import DisplacementDeformation
from dnerf.distributed import LostProcess, Processes, started
from dnerf.error_map import ErrorMap
from dnerf.fields import DeformedField, GridField, NeRFField, SpaceTimeVolumes
from dnerf.losses import Loss, PhotometricLoss
from dnerf.missing_matter import MissingMatterCheck
from dnerf.renderer import Renderer
from dnerf.run_state import CheckpointFolder
from dnerf.samplers import ImportanceSampler, OccupancySampler
from dnerf.scenes import make_scene
from dnerf.stopping import TrainingStopped
from dnerf.training import Trainer

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
CPU = torch.device("cpu")


def deformation() -> DisplacementDeformation:
    return DisplacementDeformation(2, 16, (), position_frequencies=3, time_frequencies=2)


def mlp() -> tuple[Renderer, dict[str, Any]]:
    field = DeformedField(deformation(), NeRFField(2, 32, (), position_frequencies=4, density_shift=-1.0))
    return Renderer(field, ImportanceSampler(16, 16, box=BOX), RandomBackground()), {"num_rays": 101}


def grid() -> tuple[Renderer, dict[str, Any]]:
    """The fast path: rays adapted to samples; occupancy, errors and missing matter, known from what each sees."""
    volumes = SpaceTimeVolumes(BOX, (4,), (4,), waits=True)
    canonical = GridField(BOX, (8, 16, 32), 4, hidden_features=16, space_time=volumes, density_shift=-4.0)
    sampler = OccupancySampler(BOX, 0.1, 24, num_slabs=4, update_every=4, num_probes=512, pad_to=1)
    return Renderer(DeformedField(deformation(), canonical), sampler, RandomBackground()), {
        "num_rays": 64, "target_samples": 1500, "error_map": ErrorMap(resolution=8),
        "missing_matter": MissingMatterCheck(0.01, begin=0.4, every=2, min_steps=0),
    }  # fmt: skip


class SeenAtOnce(BodySearch):
    """Searches as if training had shown where pictures are wrong."""

    def __call__(self, step: int, renderer: Renderer, frames: Frames, error_map: ErrorMap) -> bool:
        return super().__call__(step, renderer, frames, wrong_where_matter_is(frames))


def bodies() -> tuple[Renderer, dict[str, Any]]:
    """A fast ball is found, carried and learnt."""
    return a_renderer(), {
        "frames": frames_of_two_balls(), "num_rays": 64, "target_samples": 1500, "error_map": ErrorMap(resolution=24),
        "body_search": SeenAtOnce(BOX, 0.3, min_steps=2),
    }  # fmt: skip


MODELS = {"mlp": mlp, "grid": grid, "bodies": bodies}


class Mishap(Loss):
    """No loss, but a signal that this process sends to itself at a step, if it has that rank."""

    def __init__(self, number: int, rank: int, step: int = 3) -> None:
        super().__init__()
        self.number, self.rank, self.steps_left = number, rank, step

    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        self.steps_left -= 1
        if self.steps_left == 0 and os.environ["RANK"] == str(self.rank):
            os.kill(os.getpid(), self.number)
        return rendering.rgb.sum() * 0


def train(model: str, steps: int, processes: Processes, folder: Path, **changes: Any) -> dict[str, Any]:
    """The first and final state of a training, and what its log says."""
    torch.manual_seed(0)
    renderer, settings = MODELS[model]()
    before = {name: value.clone() for name, value in renderer.state_dict().items()}
    frames = settings.pop("frames", None) or SyntheticData(make_scene("walker"), 16, num_train=6).frames("train")
    records: list[dict[str, Any]] = []
    settings |= {"log_every": 1, "checkpoint_every": 7, "progress_bar": False, **changes}
    Trainer(num_steps=steps, **settings).fit(
        renderer,
        frames,
        seed=5,
        callbacks=[lambda record, _: records.append({**vars(record), "seconds": 0})],
        checkpoints=CheckpointFolder(folder),
        processes=processes,
    )
    processes.merge_observations(renderer)
    return {"before": before, "state": dict(renderer.state_dict()), "records": records}


def forked(work: Callable[[int], Any], count: int) -> tuple[list[int], list[Any]]:
    """Exit statuses and results of `work(rank)` in forked processes that know of each other.

    When one has ended otherwise than well, those that have been stopped by SIGSTOP are killed at the end.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        pids = [os.fork() or _child(work, rank, count, port, folder) for rank in range(count)]
        codes = [0] * count
        for rank in range(count):
            _, status = os.waitpid(pids[rank], os.WUNTRACED)
            if os.WIFSTOPPED(status):
                codes[rank] = os.WSTOPSIG(status)
            else:
                codes[rank] = os.waitstatus_to_exitcode(status)
        for pid, code in zip(pids, codes):
            if code == signal.SIGSTOP:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
        files = [Path(f"{folder}/{rank}.pt") for rank in range(count)]
        return codes, [torch.load(file) if file.exists() else None for file in files]


def _child(work: Callable[[int], Any], rank: int, count: int, port: int, folder: str) -> int:
    os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
    os.environ.update(RANK=str(rank), WORLD_SIZE=str(count), LOCAL_RANK=str(rank))
    code = 1
    try:
        torch.save(work(rank), f"{folder}/{rank}.pt")
        code = 0
    except TrainingStopped as stop:
        code = stop.exit_code
    except (LostProcess, ValueError) as error:
        torch.save(f"{type(error).__name__}: {error}", f"{folder}/{rank}.pt")
        code = 2
    except BaseException:
        traceback.print_exc()
        raise
    finally:
        os._exit(code)


def compare(model: str, steps: int, count: int) -> dict[str, Any]:
    """Largest differences between `count` processes and one, and among the processes."""
    with tempfile.TemporaryDirectory() as place:

        def together(rank: int) -> dict[str, Any]:
            with started(CPU, 60) as processes:
                return train(model, steps, processes, Path(place) / f"{rank}")

        _, (alone,) = forked(lambda rank: train(model, steps, Processes(), Path(place) / "alone"), 1)
        _, several = forked(together, count)
        written = [len(list(Path(place).glob(f"{rank}/*"))) for rank in range(count)]
    before, one, first = alone["before"], alone["state"], several[0]["state"]
    floats = [name for name, value in one.items() if value.is_floating_point()]
    records = list(zip(alone["records"], several[0]["records"], strict=True))
    return {
        "difference": max(float((one[name] - first[name]).abs().max()) for name in floats),
        "moved": max(float((one[name] - before[name]).abs().max()) for name in floats),
        "occupancy_equal": all(torch.equal(one[name], first[name]) for name in one.keys() - set(floats)),
        "occupied": [float(value.float().mean()) for name, value in one.items() if name.endswith("occupied")],
        "processes_equal": all(torch.equal(first[name], o["state"][name]) for o in several[1:] for name in first),
        "joined": [bool(value) for name, value in one.items() if name.endswith("joined")],
        "bodies": [int((value > 0).sum()) for name, value in one.items() if name.endswith("bodies.radii")],
        "num_rays_equal": all(a["num_rays"] == b["num_rays"] for a, b in records),
        "num_rays_vary": len({a["num_rays"] for a, _ in records}) > 1,
        "loss_difference": max(abs(a["losses"]["loss"] - b["losses"]["loss"]) for a, b in records),
        "files_written": written,
    }


def mishap(number: int, rank: int, timeout: float) -> dict[str, Any]:
    """What becomes of two processes when one gets a signal at step 3."""
    with tempfile.TemporaryDirectory() as place:

        def together(own_rank: int) -> None:
            with started(CPU, timeout) as processes:
                losses = {"rgb": PhotometricLoss(), "mishap": Mishap(number, rank)}
                train("mlp", 10**6, processes, Path(place), losses=losses, checkpoint_every=2)

        begin = time.perf_counter()
        codes, said = forked(together, 2)
        return {
            "codes": codes,
            "said": said,
            "seconds": time.perf_counter() - begin,
            "files": sorted(path.name for path in Path(place).iterdir()),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--mishaps", action="store_true", help="kill, hang and stop a process as well")
    given = parser.parse_args()
    torch.set_num_threads(1)  # comparing large tensors begins threads otherwise, and forks of such a process hang
    load_everything()
    result: dict[str, Any] = {model: compare(model, given.steps, given.processes) for model in MODELS}
    if given.mishaps:
        result["killed"] = mishap(signal.SIGKILL, 1, 60)
        result["hanging"] = mishap(signal.SIGSTOP, 1, 8)
        result["told to stop"] = mishap(signal.SIGTERM, 1, 60)
    sys.stdout.write(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
