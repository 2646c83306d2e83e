"""Run a benchmark suite and write its report: python scripts/benchmark.py suite=kernels [quick=true] [out_dir=...]"""

import shlex
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from hydra import compose
from hydra_app import build, resolve_device, run_app
from omegaconf import DictConfig, OmegaConf

from dnerf.benchmarks import Settings, describe_machine, run_suite, write_report
from dnerf.benchmarks.timing import num_threads
from dnerf.checks import check_positive


def main(config: DictConfig) -> None:
    """Run the suite named in the config, write its report, print its findings."""
    folder = Path(config.out_dir or f"runs/benchmark/{config.suite}")
    threads = torch.get_num_threads() if config.threads is None else config.threads
    check_positive("threads", threads)
    torch.manual_seed(config.seed)
    section: Any = OmegaConf.to_container(config, resolve=True)
    options = {"data_root": config.data_root, **section.get(config.suite, {})}
    device = resolve_device(config.device).type
    settings = Settings(
        quick=config.quick,
        seed=config.seed,
        device=device,
        work_dir=Path("runs/benchmark") / f"{config.suite}_work",
        train_command=(sys.executable, str(Path(__file__).with_name("train.py"))),
        build=_parts,
        options=options,
    )
    with num_threads(threads):
        machine = describe_machine()
        result = run_suite(config.suite, settings)
    command = shlex.join(["python", "scripts/benchmark.py", *sys.argv[1:]])
    date = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    path = write_report(result, folder, command=command, machine=machine, date=date)
    for finding in result.findings:
        print(f"- {finding}")
    print(f"report: {path}")


def _parts(overrides: Sequence[str]) -> Mapping[str, Any]:
    """Renderer, trainer and data of a training config with the given overrides."""
    config = compose("train", list(overrides))
    return {name: build(config[name]) for name in ("renderer", "trainer", "data")}


if __name__ == "__main__":
    run_app(main, "benchmark")
