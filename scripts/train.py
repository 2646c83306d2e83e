"""Train a model: python scripts/train.py experiment=demo [data=blender data.root=... out_dir=... key=value ...]"""

import json
from pathlib import Path
from typing import Any

import planning
import torch
from hydra_app import build, resolve_device, resolved, run_app
from omegaconf import DictConfig
from planning import FROM_DATA
from reporting import evaluate_run, print_scores
from run_folder import continued, folder_of, opened, save_config

from dnerf.core.backgrounds import ConstantBackground
from dnerf.core.files import write_json
from dnerf.data.background_check import background_contradiction, data_background
from dnerf.data.bounds import check_views
from dnerf.data.frames import Frames
from dnerf.data.scene_record import SCENE, SceneRecord, World
from dnerf.data.source import DataSource, NoImages
from dnerf.evaluation.provenance import commit, hardware
from dnerf.planning.plan import FILE
from dnerf.rendering.renderer import Renderer
from dnerf.training.records import TrainingRecord
from dnerf.training.runs import WEIGHTS
from dnerf.training.tensor_files import save_weights


def main(config: DictConfig) -> None:
    """Train, from the first step on or where the run in the folder stands."""
    device = resolve_device(config.device)
    train(continued(config), config.resume, device)


def train(config: DictConfig, resume: bool, device: torch.device) -> None:
    """Build data, model and trainer; train; save weights, facts and scores in the run's folder."""
    data = build(config.data, trusted=True)
    unscored = _unscored(config, data)
    world = find_world(config, resume, data)
    data.settle(world)
    frames = data.frames("train")
    config, background = suited(config, world, frames)
    torch.manual_seed(config.seed)
    renderer, trainer = (build(config[name], trusted=True) for name in ("renderer", "trainer"))
    parts = planning.parts_of(config)
    given = planning.given_choices(config, parts, frames, folder_of(config)) if parts else {}
    with opened(config) as folder:
        plan, begun, settings = None, None, config.get("plan")
        if parts:
            plan, begun = planning.decide(config, parts, given, frames, device, folder)
            config = planning.as_planned(config, parts, plan.choices, folder)
            torch.manual_seed(config.seed)
            renderer, trainer = (build(config[name], trusted=True) for name in ("renderer", "trainer"))
        renderer = renderer.to(device) if begun is None else begun.renderer
        said = background_contradiction(renderer.background.constant(), frames)
        if not (resume and (folder / SCENE).exists()):
            data.record().write(folder)
        if plan is not None:
            plan.save(folder / FILE)
            save_config(folder, config)
            print(plan.table())
            for line in planning.contradictions(settings, plan):
                print(f"warning: {line}")
        sizes = {f"{each.width} x {each.height}" for each in frames.intrinsics}
        size = sizes.pop() if len(sizes) == 1 else f"{len(sizes)} sizes"
        num_parameters = sum(p.numel() for p in renderer.parameters())
        print(f"{folder}: {len(frames)} frames of {size}, {num_parameters:,} parameters, on {renderer.device}")
        for note in (*world.notes, *(background if config.get(FROM_DATA) else ()), *unscored):
            print(note)
        for warning in (*world.warnings, *([said] if said else [])):
            print(f"warning: {warning}")
        record = trainer.fit(renderer, frames, seed=config.seed, folder=folder, resume=resume, begun=begun)
        finish(config, resume, folder, renderer, data, record)


def _unscored(config: DictConfig, data: DataSource) -> list[str]:
    """Check the split that will be scored; where the data set has no images of it, say so and score none."""
    if config.evaluate_split is None:
        return []
    try:
        data.check(config.evaluate_split)
    except NoImages as error:
        config.evaluate_split = None
        return [f"nothing will be scored: {error}"]
    return []


def find_world(config: DictConfig, resume: bool, data: DataSource) -> World:
    """The world of the run that is continued, or of its data set."""
    if resume and (folder_of(config) / SCENE).exists():
        return SceneRecord.read(folder_of(config)).world
    return data.world()


def suited(config: DictConfig, world: World, frames: Frames) -> tuple[DictConfig, list[str]]:
    """The resolved config with the data's box and, if it follows the data, background; and what to say of the latter.

    Raises:
        ValueError: if no camera sees into the box.
    """
    said = []
    if config.get(FROM_DATA):
        color, why = data_background(frames)
        said = [f"background: {why}"]
        if color is not None:
            target = f"{ConstantBackground.__module__}.{ConstantBackground.__name__}"
            config.background = {"_target_": target, "color": color}
    config.box = [list(corner) for corner in world.box]
    check_views(frames, torch.tensor(world.box), world.similarity)
    return resolved(config), said


def finish(
    config: DictConfig, resume: bool, folder: Path, renderer: Renderer, data: DataSource, record: TrainingRecord
) -> None:
    """Write what a finished run leaves: weights, facts of its training, scores."""
    training = {
        "train_seconds": record.seconds, "num_steps": record.step,
        "num_parameters": sum(p.numel() for p in renderer.parameters()), "seed": config.seed,
        "train_hardware": hardware(), "train_commit": commit(),
    }  # fmt: skip
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
