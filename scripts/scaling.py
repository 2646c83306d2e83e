"""Speed of training with several processes: python scripts/scaling.py --processes 1 2 --steps 300 experiment=demo"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

TRAIN = Path(__file__).with_name("train.py")
SETTINGS = (
    "trainer.max_seconds=null", "trainer.log_every=1", "trainer.callbacks.progress_bar=null", "evaluate_split=null"
)  # fmt: skip


def measure(processes: int, steps: int, threads: int, overrides: list[str]) -> tuple[float, float, float]:
    """Rays, samples and steps per second of the later three quarters of a training.

    Raises:
        ValueError: if the training fails, with the end of what it said.
    """
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={processes}"] if processes > 1 else []
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
    with tempfile.TemporaryDirectory() as folder:
        settings = [*SETTINGS, *overrides, f"trainer.num_steps={steps}", f"out_dir={folder}/run"]
        command = [sys.executable, *launcher, str(TRAIN), *settings]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ValueError(f"{processes} processes: {done.stderr.strip()[-500:]}")
        lines = (Path(folder) / "run" / "log.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    later = records[len(records) // 4 :]
    seconds = later[-1]["seconds"] - later[0]["seconds"]
    rays, samples = (sum(record[key] for record in later[1:]) for key in ("num_rays", "num_samples"))
    return rays / seconds, samples / seconds, (len(later) - 1) / seconds


def main() -> None:
    """Measure each number of processes, the cores shared out among them, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--cores", type=int, default=len(os.sched_getaffinity(0)))
    given, overrides = parser.parse_known_args()
    print(f"{given.cores} cores, {given.steps} steps, {' '.join(overrides) or 'experiment=demo'}")
    print("processes  threads each      rays/s   samples/s   steps/s  against the first")
    first = None
    for count in given.processes:
        threads = max(1, given.cores // count)
        rays, samples, steps = measure(count, given.steps, threads, overrides)
        first = first or samples
        print(f"{count:>9}  {threads:>12}  {rays:>10,.0f}  {samples:>10,.0f}  {steps:>8.1f}  {samples / first:>17.2f}")


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
