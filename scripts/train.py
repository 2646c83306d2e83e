"""Train a model: python scripts/train.py experiment=demo [data=blender data.root=... out_dir=... key=value ...]"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from hydra_app import build, new_run_folder, resolve_device, run_app
from omegaconf import DictConfig
from reporting import evaluate_run, print_scores

from dnerf.checkpoints import save_weights
from dnerf.files import write_json
from dnerf.logs import JsonLinesLog, Previews, TensorBoardLog, tensorboard_writer
from dnerf.provenance import commit, hardware


def main(config: DictConfig) -> None:
    """Build data, model and trainer; train; save weights, logs and scores in the run's folder."""
    device = resolve_device(config.device)
    torch.manual_seed(config.seed)
    data = build(config.data)
    frames = data.frames("train")
    renderer = build(config.renderer).to(device)
    trainer = build(config.trainer)
    num_parameters = sum(p.numel() for p in renderer.parameters())
    folder = new_run_folder(config)
    size = f"{frames.intrinsics.width} x {frames.intrinsics.height}"
    print(f"{folder}: {len(frames)} frames of {size}, {num_parameters:,} parameters, on {device}")
    with_writer = tensorboard_writer(folder / "tensorboard") if config.tensorboard else None
    record = trainer.fit(renderer, frames, seed=config.seed, callbacks=_callbacks(config, folder, data, with_writer))
    save_weights(renderer, folder / "model.safetensors")
    training = {
        "train_seconds": record.seconds,
        "num_steps": record.step,
        "num_parameters": num_parameters,
        "seed": config.seed,
        "train_hardware": hardware(),
        "train_commit": commit(),
    }
    write_json(folder / "training.json", training)
    if with_writer is not None:
        with_writer.close()
    if config.evaluate_split is not None:
        print_scores(
            evaluate_run(
                folder, renderer, data, config.evaluate_split, max_frames=config.evaluate_frames, chunk=config.chunk
            ),
            folder,
        )


def _callbacks(config: DictConfig, folder: Path, data: Any, writer: Any) -> list[Callable[..., None]]:
    callbacks: list[Callable[..., None]] = [JsonLinesLog(folder / "log.jsonl")]
    if writer is not None:
        callbacks.append(TensorBoardLog(writer))
    if config.preview_every:
        callbacks.append(Previews(folder / "previews", data.frames("val"), config.preview_every, writer))
    return callbacks


if __name__ == "__main__":
    run_app(main, "train")
