"""Train a model: python scripts/train.py experiment=demo [data=blender data.root=... out_dir=... key=value ...]"""

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from hydra_app import build, resolve_device, run_app
from omegaconf import DictConfig, OmegaConf
from reporting import evaluate_run, print_scores
from run_folder import continued, in_box, opened, save_config

from dnerf.box_check import BoxTooLarge, check_views
from dnerf.checkpoints import save_weights
from dnerf.data.frames import Frames
from dnerf.data.source import DataSource
from dnerf.distributed import Processes, started
from dnerf.files import write_json
from dnerf.logs import JsonLinesLog, Previews, TensorBoardLog, tensorboard_writer
from dnerf.motion_search import MotionSearch, has_unknown_motion
from dnerf.provenance import commit, hardware
from dnerf.renderer import Renderer
from dnerf.run_state import CheckpointFolder
from dnerf.training import Trainer, TrainingRecord


def main(config: DictConfig) -> None:
    """Train, alone or as one of the processes that torchrun started."""
    device = resolve_device(config.device)
    with started(device, config.process_timeout) as processes, ExitStack() as held:
        settings = processes.from_first(lambda: OmegaConf.to_yaml(continued(config), resolve=True).encode())
        assert settings is not None
        agreed = OmegaConf.create(settings.decode())
        assert isinstance(agreed, DictConfig)
        train(agreed, config.resume, device, processes, held)


def train(config: DictConfig, resume: bool, device: torch.device, processes: Processes, held: ExitStack) -> None:
    """Build data, model and trainer; train; save weights, logs and scores in the run's folder."""
    data = build(config.data)
    model = _model(config, device)
    # Runs of before there was any have no such setting.
    search = None if config.get("motion_search") is None else build(config.motion_search)
    for split in {config.evaluate_split, "val" if config.preview_every else None} - {None}:
        data.check(split)
    frames = data.frames("train")  # after what can be refused in no time: exact frames are rendered first
    check_views(frames, data.box)
    name = processes.from_first(lambda: str(held.enter_context(opened(config))).encode())
    assert name is not None
    folder = Path(name.decode())
    found = _fit(config, model, folder, data, frames, resume, processes, held)
    while isinstance(found, BoxTooLarge):
        box = [[float(f"{value:.6g}") for value in corner] for corner in found.box]
        config = in_box(config, box, found.seconds)
        if processes.is_first:
            print(f"{folder}: after {found.seconds:.0f} s: the box can be {box}; beginning anew in there")
            CheckpointFolder(folder / "checkpoints").clear()
            save_config(folder, config)
        model = _model(config, device)
        found = _fit(config, model, folder, data, frames, resume, processes, held)
    record, (renderer, _) = found, model
    num_parameters = sum(p.numel() for p in renderer.parameters())
    if not processes.is_first:
        return
    training = {
        "train_seconds": record.seconds,
        "num_steps": record.step,
        "num_parameters": num_parameters,
        "seed": config.seed,
        "train_hardware": hardware(),
        "train_commit": commit(),
    }
    if resume and _is_scored(folder, config, training):
        print(f"{folder}: finished before, nothing to do")
        return
    if search is not None:
        _search_motion(search, config, renderer, frames)
    save_weights(renderer, folder / "model.safetensors")
    write_json(folder / "training.json", training)
    if config.evaluate_split is not None:
        print_scores(
            evaluate_run(
                folder, renderer, data, config.evaluate_split, max_frames=config.evaluate_frames, chunk=config.chunk
            ),
            folder,
        )


def _model(config: DictConfig, device: torch.device) -> tuple[Renderer, Trainer]:
    """A model as the seed makes it, and its trainer."""
    torch.manual_seed(config.seed)
    return build(config.renderer).to(device), build(config.trainer)


def _fit(
    config: DictConfig,
    model: tuple[Renderer, Trainer],
    folder: Path,
    data: DataSource,
    frames: Frames,
    resume: bool,
    processes: Processes,
    held: ExitStack,
) -> TrainingRecord | BoxTooLarge:
    """Train the model until the end, or until its box turns out to be far too large."""
    renderer, trainer = model
    box_fit = config.get("box_fit")  # runs of before it was there have none
    callbacks: list[Callable[..., None]] = []
    if processes.is_first:
        size = f"{frames.intrinsics.width} x {frames.intrinsics.height}"
        num_parameters = sum(p.numel() for p in renderer.parameters())
        print(f"{folder}: {len(frames)} frames of {size}, {num_parameters:,} parameters, on {renderer.device}")
        callbacks = _callbacks(config, folder, data, held)
    try:
        return trainer.fit(
            renderer,
            frames,
            seed=config.seed,
            callbacks=callbacks,
            checkpoints=CheckpointFolder(folder / "checkpoints"),
            resume=resume,
            processes=processes,
            seconds=0.0 if box_fit is None else box_fit.seconds,
        )
    except BoxTooLarge as found:
        return found.with_traceback(None)  # which holds the model


def _search_motion(search: MotionSearch, config: DictConfig, renderer: Renderer, frames: Frames) -> None:
    """Read off the trained field the motion that its deformation does not know, if there is any."""
    start = time.perf_counter()
    if has_unknown_motion(renderer):
        print("motion: looking for what the deformation does not move (motion_search)")
    found = search(renderer, frames, seed=config.seed, progress_bar=config.trainer.progress_bar)
    if found is not None:
        said = "found" if found.is_motion else "nothing found"
        print(
            f"motion: {said} in {time.perf_counter() - start:.0f} s; what the field holds changes by "
            f"{found.deformed:.4f} along the deformation's tracks, by {found.carried:.4f} along a flow's"
        )


def _is_scored(folder: Path, config: DictConfig, training: dict[str, Any]) -> bool:
    """Whether the scores that this run would end with are there already."""
    try:
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        known = json.loads((folder / "training.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    wanted = config.evaluate_frames
    return (
        known == training
        and (folder / "model.safetensors").is_file()
        and metrics["split"] == config.evaluate_split
        and metrics["num_steps"] == training["num_steps"]
        and (wanted is None or metrics["num_frames"] == wanted)
    )


def _callbacks(config: DictConfig, folder: Path, data: Any, held: ExitStack) -> list[Callable[..., None]]:
    callbacks: list[Callable[..., None]] = [JsonLinesLog(folder / "log.jsonl")]
    writer = None
    if config.tensorboard:
        writer = tensorboard_writer(folder / "tensorboard")
        held.callback(writer.close)
        callbacks.append(TensorBoardLog(writer))
    if config.preview_every:
        callbacks.append(Previews(folder / "previews", data.frames("val"), config.preview_every, writer))
    return callbacks


if __name__ == "__main__":
    run_app(main, "train")
