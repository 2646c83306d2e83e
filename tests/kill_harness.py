"""Kill training at random moments, resume it, and compare with the run that nobody killed.

    python tests/kill_harness.py --kills 50

Each run is killed `--kills-per-run` times by SIGKILL, by turns at a random moment of the time it would still take and
while a checkpoint is being written; then it is resumed to its end. Its weights, optimiser, random states, log and
list of files must be those of a run that was left alone. Processes are forked from one that has loaded everything.
"""

import argparse
import json
import os
import random
import runpy
import signal
import sys
import tempfile
import time
from pathlib import Path

from preload import load_everything

ROOT = Path(__file__).resolve().parents[1]
COMMAND = (
    "experiment=demo", "data.resolution=24", "data.num_train=4", "data.num_val=1", "data.num_test=1",
    "field.resolutions=[8,16,32]", "sampler.grid.resolution=24", "sampler.grid.num_slabs=4",
    "+sampler.grid.update_every=4", "+sampler.grid.num_probes=2048", "trainer.max_seconds=null", "trainer.num_rays=64",
    "trainer.target_samples=2048", "trainer.num_steps=40", "trainer.callbacks.checkpoints.every=3",
    "trainer.log_every=5", "~trainer.callbacks.progress_bar", "+trainer/callbacks=previews",
    "trainer.callbacks.previews.every=20",
)  # fmt: skip


def start(folder: Path, *overrides: str) -> int:
    """Fork a process that runs the training script as a user would; its id."""
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        silence = os.open(folder.parent / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        os.chdir(folder.parent)
        script = str(ROOT / "scripts" / "train.py")
        sys.argv = [script, *COMMAND, f"out_dir={folder.name}", *overrides]
        sys.path.insert(0, str(ROOT / "scripts"))
        runpy.run_path(script, run_name="__main__")
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        sys.stdout.flush()
        os._exit(code)


def finish(folder: Path, *overrides: str) -> float:
    """Run to the end; the seconds it took."""
    begin = time.perf_counter()
    _, status = os.waitpid(start(folder, *overrides), 0)
    if status:
        text = (folder.parent / "output.txt").read_text()
        raise AssertionError(f"{folder} ended with status {status}:\n{text[-4000:]}")
    return time.perf_counter() - begin


def kill(folder: Path, delay: float, *, while_writing: bool) -> str:
    """Start a run and kill it after a delay, or at the first half-written checkpoint after it; how it ended."""
    pid = start(folder, "resume=true")
    end = time.perf_counter() + delay
    while os.waitpid(pid, os.WNOHANG) == (0, 0):
        if time.perf_counter() >= end:
            caught = any(folder.glob("checkpoints/.tmp-*"))
            if caught or not while_writing:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                return "killed while writing" if caught else "killed"
        time.sleep(0 if while_writing else 0.001)
    return "had ended"


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def log(folder: Path) -> list[dict[str, object]]:
    """The log without what depends on the clock."""
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key != "seconds"} for line in lines]


def differences(folder: Path, expected: Path) -> list[str]:
    """What distinguishes two finished runs, times apart."""
    from dnerf.training.tensor_files import decode

    found = [f"file: {name}" for name in sorted(files(folder) ^ files(expected))]
    if (folder / "model.safetensors").read_bytes() != (expected / "model.safetensors").read_bytes():
        found.append("weights")
    if log(folder) != log(expected):
        found.append("log")
    for path in sorted(expected.glob("checkpoints/*")):
        both = (decode(p.read_bytes()) for p in (path, folder / "checkpoints" / path.name))
        (tensors, facts), (others, other_facts) = both
        assert facts is not None
        assert other_facts is not None
        found += [f"{path.name}: {n}" for n in tensors if tensors[n].numpy().tobytes() != others[n].numpy().tobytes()]
        found += [f"{path.name}: {n}" for n in ("step", "num_rays", "rays_done") if facts[n] != other_facts[n]]
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--kills-per-run", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    load_everything()
    chance = random.Random(arguments.seed)
    endings: dict[str, int] = {}
    failures = 0
    with tempfile.TemporaryDirectory() as place:
        expected = Path(place) / "expected"
        finish(expected)  # compiles the kernels
        lasted = finish(Path(place) / "again")
        found = differences(Path(place) / "again", expected)
        print(f"an uninterrupted run takes {lasted:.1f} s; differences between two: {', '.join(found) or 'none'}")
        done = runs = 0
        while done < arguments.kills:
            folder, runs = Path(place) / f"run{runs}", runs + 1
            for turn in range(min(arguments.kills_per_run, arguments.kills - done)):
                while_writing = turn % 2 == 1
                delay = chance.uniform(0, lasted / 2 if while_writing else lasted)
                ending = kill(folder, delay, while_writing=while_writing)
                endings[ending] = endings.get(ending, 0) + 1
                done += ending != "had ended"
            finish(folder, "resume=true")
            found = differences(folder, expected)
            failures += bool(found)
            print(f"{folder.name}: {done} kills so far; {', '.join(found) or 'identical, no stray file'}", flush=True)
    print(f"{done} kills ({', '.join(f'{n} {ending}' for ending, n in sorted(endings.items()))}), {failures} failures")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
