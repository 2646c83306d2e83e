"""Train with two forked processes and with one, and say how far the results are apart, as JSON; then disturb the two.

Started by the tests in a process of its own, since processes that have begun threads must not fork.
"""

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
from small_runs import BOX, Watch
from torch import Tensor

from dnerf.core.backgrounds import RandomBackground
from dnerf.core.compositing import Rendering
from dnerf.data import SyntheticData
from dnerf.data.pixel_samplers import ErrorGuidedPixels, TemporalCurriculum
from dnerf.deformations import DisplacementDeformation
from dnerf.fields import DeformedField, GridField, NeRFField
from dnerf.losses import Batch, Loss, PhotometricLoss
from dnerf.rendering import Renderer
from dnerf.samplers import ImportanceSampler, OccupancyGrid, OccupancySampler
from dnerf.scenes import make_scene
from dnerf.training import Checkpoints, Trainer, TrainingStopped
from dnerf.training.distributed import LostProcess, Processes, started

CPU = torch.device("cpu")


def deformation() -> DisplacementDeformation:
    return DisplacementDeformation(2, 16, (), position_frequencies=3, time_frequencies=2)


def mlp() -> tuple[Renderer, dict[str, Any]]:
    field = DeformedField(deformation(), NeRFField(2, 32, (), position_frequencies=4, density_shift=-1.0))
    return Renderer(field, ImportanceSampler(16, 16, box=BOX), RandomBackground()), {"num_rays": 101}


def grid() -> tuple[Renderer, dict[str, Any]]:
    """The fast path: rays adapted to samples; occupancy and errors known from what each process sees."""
    canonical = GridField(BOX, (8, 16, 32), 4, hidden_features=16, density_shift=-4.0)
    cells = OccupancyGrid(BOX, 24, num_slabs=4, update_every=4, num_probes=512)
    renderer = Renderer(
        DeformedField(deformation(), canonical), OccupancySampler(cells, 0.1, pad_to=1), RandomBackground()
    )
    pixels = ErrorGuidedPixels(TemporalCurriculum(), resolution=8)
    return renderer, {"num_rays": 64, "target_samples": 1500, "pixels": pixels}


MODELS = {"mlp": mlp, "grid": grid}


class Mishap(Loss):
    """No loss, but a signal that the second process sends to itself at step 3."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number, self.steps_left = number, 3

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        self.steps_left -= 1
        if self.steps_left == 0 and os.environ["RANK"] == "1":
            os.kill(os.getpid(), self.number)
        return rendering.rgb.sum() * 0


def train(model: str, steps: int, processes: Processes, folder: Path, every: int = 7, **changes: Any) -> dict[str, Any]:
    """The first and final state of a training, and what its log says."""
    torch.manual_seed(0)
    renderer, settings = MODELS[model]()
    before = {name: value.clone() for name, value in renderer.state_dict().items()}
    frames = SyntheticData(make_scene("walker"), 16, num_train=6).frames("train")
    records = Watch()
    callbacks = {"records": records, "checkpoints": Checkpoints(every)}
    trainer = Trainer(num_steps=steps, log_every=1, callbacks=callbacks, **(settings | changes))
    trainer.fit(renderer, frames, seed=5, folder=folder, processes=processes)
    processes.merge_observations(renderer)
    pixels = {f"pixels.{name}": value for name, value in trainer.pixels.state_dict().items()}
    kept = [{**vars(record), "seconds": 0} for record in records.records]  # the clock aside
    return {"before": before, "state": {**renderer.state_dict(), **pixels}, "records": kept}


def forked(work: Callable[[int], Any], count: int) -> tuple[list[int], list[Any]]:
    """Exit statuses and results of `work(rank)` in forked processes that know of each other.

    When one has ended otherwise than well, those that have been stopped by SIGSTOP are killed at the end.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        pids = [os.fork() or _child(work, rank, count, port, folder) for rank in range(count)]
        codes = []
        for pid in pids:
            _, status = os.waitpid(pid, os.WUNTRACED)
            codes.append(os.WSTOPSIG(status) if os.WIFSTOPPED(status) else os.waitstatus_to_exitcode(status))
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


def compare(model: str) -> dict[str, Any]:
    """Largest differences between two processes and one, and among the two."""
    with tempfile.TemporaryDirectory() as place:

        def together(rank: int) -> dict[str, Any]:
            with started(CPU, 60) as processes:
                return train(model, 20, processes, Path(place) / f"{rank}")

        _, (alone,) = forked(lambda rank: train(model, 20, Processes(), Path(place) / "alone"), 1)
        _, (two, other) = forked(together, 2)
        written = [len(list(Path(place).glob(f"{rank}/checkpoints/*"))) for rank in range(2)]
    before, one, first = alone["before"], alone["state"], two["state"]
    floats = {name for name, value in one.items() if value.is_floating_point()}
    records = list(zip(alone["records"], two["records"], strict=True))
    return {
        "difference": max(float((one[name] - first[name]).abs().max()) for name in floats),
        "moved": max(float((one[name] - before[name]).abs().max()) for name in before.keys() & floats),
        "occupancy_equal": all(torch.equal(one[name], first[name]) for name in one.keys() - floats),
        "occupied": [float(value.float().mean()) for name, value in one.items() if name.endswith("occupied")],
        "processes_equal": all(torch.equal(value, other["state"][name]) for name, value in first.items()),
        "num_rays_equal": all(a["num_rays"] == b["num_rays"] for a, b in records),
        "num_rays_vary": len({a["num_rays"] for a, _ in records}) > 1,
        "loss_difference": max(abs(a["losses"]["loss"] - b["losses"]["loss"]) for a, b in records),
        "files_written": written,
    }


def mishap(number: int, timeout: float) -> dict[str, Any]:
    """What becomes of two processes when the second gets a signal at step 3."""
    with tempfile.TemporaryDirectory() as place:

        def together(rank: int) -> None:
            with started(CPU, timeout) as processes:
                losses = {"rgb": PhotometricLoss(), "mishap": Mishap(number)}
                train("mlp", 10**6, processes, Path(place), every=2, losses=losses)

        begin = time.perf_counter()
        codes, said = forked(together, 2)
        names = sorted(path.name for path in Path(place).glob("checkpoints/*"))
        return {"codes": codes, "said": said, "seconds": time.perf_counter() - begin, "files": names}


def main() -> None:
    torch.set_num_threads(1)  # comparing large tensors begins threads otherwise, and forks of such a process hang
    load_everything()
    result = {model: compare(model) for model in MODELS}
    for case, number, timeout in (("killed", "KILL", 60), ("hanging", "STOP", 5), ("told to stop", "TERM", 60)):
        result[case] = mishap(signal.Signals[f"SIG{number}"], timeout)
    sys.stdout.write(json.dumps(result))


if __name__ == "__main__":
    main()
