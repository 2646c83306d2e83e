"""Score runs on held-out frames: python scripts/evaluate.py run=runs/mutant protocol=dnerf"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from hydra_app import build, load_config, load_renderer, moved, resolve_device, run_app
from omegaconf import DictConfig
from reporting import evaluate_run, print_scores
from torch import Tensor

from dnerf.backgrounds import ConstantBackground
from dnerf.cameras import Camera
from dnerf.data import DataSource, Frames, SyntheticData
from dnerf.evaluation import FrameScore, evaluate
from dnerf.files import write_json, write_text
from dnerf.logs import SHEET_COLUMNS
from dnerf.metrics.perceptual import lpips_metric
from dnerf.plots import frame_curves
from dnerf.protocols import LEGO, Protocol, csv_table, find_protocol, markdown_table, table_json, table_notes
from dnerf.provenance import provenance
from dnerf.renderer import Renderer
from dnerf.temporal_evaluation import evaluate_over_time
from dnerf.video import contact_sheet, error_map, write_png

Lpips = Callable[[Tensor, Tensor], float] | None


def main(config: DictConfig) -> None:
    """Score every run, write its files, print and write the table."""
    runs = [str(run) for run in config.runs] or ([] if config.run is None else [config.run])
    if not runs or (config.runs and config.run is not None):
        raise ValueError("run: give run=<folder> or runs=[<folder>,...], one of the two")
    protocol = None if config.protocol is None else find_protocol(config.protocol)
    lpips = lpips_metric(config.lpips.backbone, download=config.lpips.download) if config.lpips.enabled else None
    # A wrong name or a damaged file in a long list should not be found out after hours.
    for run in runs:
        saved = load_config(run)
        if len(runs) > 1:
            load_renderer(run, saved, torch.device("cpu"))
    rows = [_score(config, run, protocol, lpips) for run in runs]
    if len(rows) > 1 or config.table is not None:
        _write_tables(config, runs, rows)


def _score(config: DictConfig, run: str, protocol: Protocol | None, lpips: Lpips) -> dict[str, Any]:
    """Score one run and write everything into its folder; returns the scores."""
    saved = load_config(run)
    moved(saved, config.data_root)
    if protocol is not None:
        saved.data.resolution = protocol.resolution
    scene = _scene_name(saved)
    split = config.split or (protocol.split if protocol is not None else "test")
    if scene == LEGO and config.lego_split is not None:
        split = config.lego_split
    renderer, data = load_renderer(run, saved, resolve_device(config.device)), build(saved.data)
    if protocol is not None:
        if not data.frames(split).has_alpha:
            raise ValueError(f"protocol: {protocol.name} composites on {protocol.background}, {run} has no alpha")
        renderer.background = ConstantBackground(protocol.background).to(renderer.device)
    folder, suffix = Path(run), "" if protocol is None else f"_{protocol.name}_{split}"
    settings = {
        "scene": scene,
        "method": config.label or _method_name(saved),
        "protocol": "own" if protocol is None else protocol.name,
    }
    if lpips is not None:
        settings["lpips_backbone"] = config.lpips.backbone
    chunk, name = config.chunk or saved.chunk, f"metrics{suffix}.json"
    metrics = evaluate_run(
        folder, renderer, data, split, max_frames=config.max_frames, chunk=chunk, settings=settings, name=name,
        lpips=lpips,
    )  # fmt: skip
    print_scores(metrics, folder, name)
    _write_worst(folder, renderer, data.frames(split), metrics, config.worst, chunk)
    if config.plots:
        _write_curves(folder / f"curves_{split}.svg", {scene: metrics["frames"]})
    if config.temporal.enabled:
        _write_temporal(config, folder, renderer, data, chunk, settings)
    return metrics


def _scene_name(saved: DictConfig) -> str:
    """The folder's name of a data set, the maker's name of an exact scene."""
    if "root" in saved.data:
        return Path(saved.data.root).resolve().name
    target = str(saved.data.scene.get("_target_", "")) if "scene" in saved.data else ""
    return target.rpartition(".")[2].removeprefix("make_") or "unknown"


def _method_name(saved: DictConfig) -> str:
    field = saved.renderer.field
    parts = [field.deformation, field.canonical] if "deformation" in field else [field]
    names = [str(part.get("_target_", "?")).rpartition(".")[2] for part in parts]
    return " + ".join(name.removesuffix("Deformation").removesuffix("Field") for name in names)


def _write_worst(
    folder: Path, renderer: Renderer, frames: Frames, metrics: dict[str, Any], count: int, chunk: int
) -> None:
    """Draw the frames with the lowest PSNR beside the truth, worst first."""
    if count <= 0:
        return
    worst = sorted(metrics["frames"], key=lambda frame: frame["psnr"])[:count]
    rows: list[list[Tensor]] = []

    def keep(score: FrameScore, prediction: Tensor, truth: Tensor) -> None:
        rows.append([prediction, truth, error_map(prediction, truth)])

    evaluate(renderer, frames.subset([frame["index"] for frame in worst]), chunk=chunk, on_frame=keep)
    labels = [f"frame {frame['index']}, t = {frame['time']:.2f}, {frame['psnr']:.1f} dB" for frame in worst]
    path = folder / f"worst_frames_{metrics['split']}.png"
    write_png(contact_sheet(rows, columns=SHEET_COLUMNS, rows=labels), path)
    print(f"worst frames:  {path}")


def _write_curves(path: Path, runs: dict[str, Any]) -> None:
    try:
        svg = frame_curves(runs)
    except ValueError as error:
        print(f"no curves: {error}")
        return
    write_text(path, svg)
    print(f"curves:        {path}")


def _write_temporal(
    config: DictConfig, folder: Path, renderer: Renderer, data: DataSource, chunk: int, settings: dict[str, Any]
) -> None:
    frames = data.frames("test").to(renderer.device)
    size = config.temporal.resolution
    height = round(size * frames.intrinsics.height / frames.intrinsics.width)
    camera = Camera(frames.intrinsics.resized(size, height), frames.poses[0], frames.near, frames.far)
    scene = data.scene.to(renderer.device) if isinstance(data, SyntheticData) else None
    scores = evaluate_over_time(renderer, camera, scene, num_frames=config.temporal.num_frames, chunk=chunk)
    values = {name: value for name, value in scores.as_dict().items() if value is not None}
    write_json(folder / "temporal.json", {**values, "resolution": size, **settings, **provenance()})
    source = "exact motion" if scene is not None else "the model's own motion: consistency, not correctness"
    print(f"over time, by {source}:")
    for name, value in values.items():
        if isinstance(value, float):
            print(f"  {name.replace('_', ' '):22} {value:.5g}")
    print(f"over time:     {folder / 'temporal.json'}")


def _write_tables(config: DictConfig, runs: list[str], rows: list[dict[str, Any]]) -> None:
    path = Path(config.table or Path(runs[0]).parent / f"table_{config.protocol or 'own'}")
    listed = [{name: value for name, value in row.items() if name != "frames"} for row in rows]
    table = "\n".join([markdown_table(listed), *(f"{note}\n" for note in table_notes(listed))])
    write_text(path.with_name(f"{path.name}.md"), table)
    write_text(path.with_name(f"{path.name}.csv"), csv_table(listed))
    write_json(path.with_name(f"{path.name}.json"), table_json(listed))
    print(f"\n{table}")
    if config.plots:
        names = [f"{row['method']}: {row['scene']}" for row in rows]
        unique = [f"{name} ({Path(run).name})" if names.count(name) > 1 else name for name, run in zip(names, runs)]
        _write_curves(path.with_name(f"{path.name}.svg"), dict(zip(unique, (row["frames"] for row in rows))))
    print(f"table:         {path}.md, .csv, .json")


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    run_app(main, "evaluate")
