"""Train a model: python scripts/train.py experiment=demo [data=blender data.root=... out_dir=... key=value ...]"""

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from hydra_app import build, resolve_device, run_app
from omegaconf import DictConfig, OmegaConf
from reporting import evaluate_run, print_scores
from run_folder import FITTED, continued, opened, resolved

from dnerf.core.files import write_json
from dnerf.data.background_check import background_contradiction
from dnerf.data.bounds import check_views
from dnerf.data.frames import Frames
from dnerf.data.source import DataSource
from dnerf.evaluation.provenance import commit, hardware
from dnerf.rendering.renderer import Renderer
from dnerf.training.distributed import Processes, started
from dnerf.training.records import TrainingRecord
from dnerf.training.runs import WEIGHTS
from dnerf.training.tensor_files import save_weights


def main(config: DictConfig) -> None:
    """Train, alone or as one of the processes that torchrun started."""
    device = resolve_device(config.device)
    with started(device, config.process_timeout) as processes, ExitStack() as held:
        train(processes.from_first(lambda: continued(config)), config.resume, device, processes, held)


def train(config: DictConfig, resume: bool, device: torch.device, processes: Processes, held: ExitStack) -> None:
    """Build data, model and trainer; train; save weights, facts and scores in the run's folder."""
    data = build(config.data, trusted=True)
    if config.evaluate_split is not None:
        data.check(config.evaluate_split)
    frames = data.frames("train")
    fitted = config.data.get("box") == FITTED
    config = in_box(config, data, frames, processes)
    # The same seed in every process: they begin with one model.
    torch.manual_seed(config.seed)
    renderer = build(config.renderer, trusted=True).to(device)
    trainer = build(config.trainer, trusted=True)
    folder = processes.from_first(lambda: held.enter_context(opened(config)))
    if processes.is_first:
        sizes = {f"{each.width} x {each.height}" for each in frames.intrinsics}
        size = sizes.pop() if len(sizes) == 1 else f"{len(sizes)} sizes"
        num_parameters = sum(p.numel() for p in renderer.parameters())
        print(f"{folder}: {len(frames)} frames of {size}, {num_parameters:,} parameters, on {renderer.device}")
        print(f"box: {config.data.get('box')}, {'fitted to the frames' if fitted else 'as given'}")
        color = renderer.background.constant()
        if color is not None and (said := background_contradiction(color, frames)):
            print(f"warning: {said}")
    record = trainer.fit(renderer, frames, seed=config.seed, folder=folder, resume=resume, processes=processes)
    if processes.is_first:
        finish(config, resume, folder, renderer, data, record)


def in_box(config: DictConfig, data: DataSource, frames: Frames, processes: Processes) -> DictConfig:
    """The resolved config, `data.box` being the corners that the first process finds in its frames, or was given.

    Raises:
        ValueError: if no camera sees into the box.
    """
    if "box" in config.data:
        corners = processes.from_first(lambda: data.fitted_box(frames))
        if config.data.box == FITTED:
            config.data.box = corners
    config = resolved(config)
    if "box" in config.data:
        check_views(frames, torch.tensor(OmegaConf.to_container(config.data.box)))
    return config


def finish(
    config: DictConfig, resume: bool, folder: Path, renderer: Renderer, data: DataSource, record: TrainingRecord
) -> None:
    """Write what a finished run leaves: weights, facts of its training, scores."""
    training = {
        "train_seconds": record.seconds,
        "num_steps": record.step,
        "num_parameters": sum(p.numel() for p in renderer.parameters()),
        "seed": config.seed,
        "train_hardware": hardware(),
        "train_commit": commit(),
    }
    if resume and is_scored(folder, config, training):
        print(f"{folder}: finished before, nothing to do")
        return
    save_weights(renderer, folder / WEIGHTS)
    write_json(folder / "training.json", training | {"weights_bytes": (folder / WEIGHTS).stat().st_size})
    if config.evaluate_split is not None:
        metrics = evaluate_run(
            folder, renderer, data, config.evaluate_split, max_frames=config.evaluate_frames, chunk=config.chunk
        )
        print_scores(metrics, folder)


def is_scored(folder: Path, config: DictConfig, training: dict[str, Any]) -> bool:
    """Whether the scores that this run would end with are there already."""
    try:
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        known = json.loads((folder / "training.json").read_text(encoding="utf-8"))
        size = (folder / WEIGHTS).stat().st_size
    except (OSError, ValueError):
        return False
    wanted = config.evaluate_frames
    return (
        known == training | {"weights_bytes": size}
        and metrics["split"] == config.evaluate_split
        and metrics["num_steps"] == training["num_steps"]
        and (wanted is None or metrics["num_frames"] == wanted)
    )


if __name__ == "__main__":
    run_app(main, "train")
