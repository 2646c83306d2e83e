"""Run a benchmark suite, or `all`, and write its report: python scripts/benchmark.py suite=kernels [quick=true]"""

import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hydra_app import build, load_config, load_renderer, load_scene, resolve_device, run_app

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # `benchmarks` is no part of the installed package

import torch
import yaml
from hydra import compose
from omegaconf import DictConfig, OmegaConf
from train import suited

from benchmarks import Settings, describe_machine, num_threads, run_suite, suite_names, write_report
from dnerf.core.checks import check_positive

ALL = "all"


def main(config: DictConfig) -> None:
    """Run the suite named in the config, or all of them, write reports, print findings."""
    threads = torch.get_num_threads() if config.threads is None else config.threads
    check_positive("threads", threads)
    with num_threads(threads):
        if config.suite != ALL:
            _run(config, config.suite, Path(config.out_dir or f"runs/benchmark/{config.suite}"))
            return
        for name in suite_names():
            _run(config, name, Path(config.out_dir or "runs/benchmark") / name)


def _run(config: DictConfig, suite: str, folder: Path) -> None:
    torch.manual_seed(config.seed)
    section: Any = OmegaConf.to_container(config, resolve=True)
    device = resolve_device(config.device).type
    settings = Settings(
        quick=config.quick, seed=config.seed, device=device, work_dir=Path("runs/benchmark") / f"{suite}_work",
        train_command=(sys.executable, str(Path(__file__).with_name("train.py"))), build=_parts, load=_finished,
        options={"data_root": config.data_root, **section.get(suite, {})},
    )  # fmt: skip
    machine = describe_machine()
    begin = time.perf_counter()
    result = run_suite(suite, settings)
    others = [word for word in sys.argv[1:] if not word.startswith(("suite=", "out_dir="))]
    command = shlex.join(["python", "scripts/benchmark.py", f"suite={suite}", *others, f"out_dir={folder}"])
    date = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, in {time.perf_counter() - begin:.0f} s"
    path = write_report(result, folder, command=command, machine=machine, date=date)
    for finding in result.findings:
        print(f"- {finding}")
    print(f"report: {path}", flush=True)


def _parts(overrides: Sequence[str]) -> Mapping[str, Any]:
    """Renderer, trainer, data and chunk of a training config with the given overrides."""
    config = compose("train", list(overrides))
    data = build(config.data, trusted=True)
    world = data.world()
    data.settle(world)
    config, _ = suited(config, world, data.frames("train"))
    parts = {name: build(config[name], trusted=True) for name in ("renderer", "trainer")}
    return {"chunk": config.chunk, "data": data, **parts}


def _finished(run: str, overrides: Sequence[str]) -> Mapping[str, Any]:
    """Renderer, data and chunk of a finished run, some of whose settings are others.

    Raises:
        ValueError: for a setting that the run does not have.
    """
    config = load_config(run)
    for name, _, text in (change.partition("=") for change in overrides):
        if OmegaConf.select(config, name, default=ALL) == ALL:
            raise ValueError(f"frames.ways: {run} has no setting {name}")
        OmegaConf.update(config, name, yaml.safe_load(text))
    renderer = load_renderer(run, config, torch.device("cpu"))
    data = build(config.data)
    data.settle(load_scene(run).world)
    return {"renderer": renderer, "data": data, "chunk": config.chunk}


if __name__ == "__main__":
    run_app(main, "benchmark")
