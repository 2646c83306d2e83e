"""Score runs on held-out frames: python scripts/evaluate.py run=runs/mutant protocol=dnerf"""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra_app import build, load_config, load_renderer, load_scene, moved, resolve_device, run_app
from omegaconf import DictConfig
from reporting import evaluate_run, on_background_of, print_scores
from torch import Tensor

from dnerf.core.backgrounds import ConstantBackground
from dnerf.core.cameras import Camera
from dnerf.core.compositing import Rendering
from dnerf.core.files import write_json, write_text
from dnerf.core.rays import Rays
from dnerf.data import DataSource, Frames, SceneRecord, SyntheticData, random_views, render_exact
from dnerf.data.placing import planes_between
from dnerf.evaluation import FrameScore, check_consistency, error_shares, evaluate, evaluate_over_time, kinds_of
from dnerf.evaluation.error_kinds import SeenFromAside
from dnerf.evaluation.images import lpips_metric
from dnerf.evaluation.plots import frame_curves
from dnerf.evaluation.protocols import LEGO, Protocol, csv_table, find_protocol, markdown_table, table_json, table_notes
from dnerf.evaluation.provenance import provenance
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import OccupancySampler
from dnerf.scenes import AnalyticScene
from dnerf.visualization import comparison_sheet, write_png

Lpips = Callable[[Tensor, Tensor], float] | None
CONSISTENCY_PIXELS = 16
"""Width of the image whose rays are checked over time."""


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
    record = load_scene(run)
    renderer, data = load_renderer(run, saved, resolve_device(config.device)), build(saved.data)
    data.settle(record.world)
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
    kinds = ErrorKinds(data.frames(split), renderer, chunk) if config.kinds else None
    metrics = evaluate_run(
        folder, renderer, data, split, max_frames=config.max_frames, chunk=chunk, settings=settings, name=name,
        lpips=lpips, on_frame=kinds,
    )  # fmt: skip
    print_scores(metrics, folder, name)
    _write_worst(folder, renderer, data.frames(split), metrics, config.worst, chunk)
    if kinds is not None:
        print(kinds)
    if config.plots:
        _write_curves(folder / f"curves_{split}.svg", {scene: metrics["frames"]})
    if config.temporal.enabled:
        _write_temporal(config, folder, renderer, data, record, chunk, settings)
    if config.consistency:
        _write_consistency(folder, renderer, data, record, settings)
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
    pairs: list[tuple[Tensor, Tensor]] = []

    def keep(score: FrameScore, prediction: Tensor, truth: Tensor) -> None:
        pairs.append((prediction, truth))

    with on_background_of(frames, renderer):
        evaluate(renderer, frames.subset([frame["index"] for frame in worst]), chunk=chunk, on_frame=keep)
    labels = [f"frame {frame['index']}, t = {frame['time']:.2f}, {frame['psnr']:.1f} dB" for frame in worst]
    path = folder / f"worst_frames_{metrics['split']}.png"
    write_png(comparison_sheet(pairs, labels), path)
    print(f"worst frames:  {path}")


class ErrorKinds:
    """Where the error of frames with alpha lies, one line a kind; called with each frame that is scored."""

    def __init__(self, frames: Frames, renderer: Renderer, chunk: int) -> None:
        if not frames.has_alpha:
            raise ValueError("kinds: silhouettes are those of images with alpha, these have none")
        self.frames, self.chunk = frames.to(renderer.device), chunk
        self.aside = Renderer(SeenFromAside(renderer.field), renderer.sampler, renderer.background)
        self.found: list[tuple[Tensor, Tensor]] = []

    def __call__(self, score: FrameScore, prediction: Tensor, truth: Tensor) -> None:
        alpha = self.frames.stored_image(score.index)[..., 3] / 255
        aside = self.aside.render_image(self.frames.camera(score.index), score.time, chunk=self.chunk).rgb.clamp(0, 1)
        kinds = kinds_of(truth, alpha, (aside - prediction).abs().mean(-1))
        self.found.append(((prediction - truth).square().mean(-1).flatten(), kinds.flatten()))

    def __str__(self) -> str:
        shares = error_shares(*(torch.cat(part) for part in zip(*self.found, strict=True)))
        lines = (f"{n:14} {x:.2f} of the squared error, {k:.2f} of the pixels" for n, (x, k) in shares.items())
        return "\n".join(lines)


def _write_curves(path: Path, runs: dict[str, Any]) -> None:
    try:
        svg = frame_curves(runs)
    except ValueError as error:
        print(f"no curves: {error}")
        return
    write_text(path, svg)
    print(f"curves:        {path}")


def _write_temporal(
    config: DictConfig, folder: Path, renderer: Renderer, data: DataSource, record: SceneRecord, chunk: int,
    settings: dict[str, Any],
) -> None:  # fmt: skip
    size = config.temporal.resolution
    camera = _first_camera(record, size, renderer.device)
    scene = data.scene.to(renderer.device) if isinstance(data, SyntheticData) else None
    scores = evaluate_over_time(renderer, camera, scene, num_frames=config.temporal.num_frames, chunk=chunk)
    values = scores.as_dict()
    write_json(folder / "temporal.json", {**values, "resolution": size, **settings, **provenance()})
    source = "exact motion" if scene is not None else "the model's own motion: consistency, not correctness"
    print(f"over time, by {source}:")
    for name, value in values.items():
        if value is None or isinstance(value, float):
            print(f"  {name.replace('_', ' '):22} {'not measured' if value is None else f'{value:.5g}'}")
    print(f"over time:     {folder / 'temporal.json'}")


def _first_camera(record: SceneRecord, width: int, device: torch.device) -> Camera:
    """The first camera of the test split, or of the train split if there is none, with so many pixels."""
    _, cameras = record.split(None)
    intrinsics, pose = cameras.intrinsics[0], cameras.poses[0]
    resized = intrinsics.resized(width, max(1, round(width * intrinsics.height / intrinsics.width)))
    return Camera(resized, pose.to(device), *planes_between(cameras.poses, record.world))


def _write_consistency(
    folder: Path, renderer: Renderer, data: DataSource, record: SceneRecord, settings: dict[str, Any]
) -> None:
    truth: Callable[[Rays], Rendering] | None = None
    times: list[float] = []
    if isinstance(data, SyntheticData):
        truth = partial(_exact_images, data.scene.to(renderer.device), renderer)
        last = 1.0 if data.train_end is None else data.train_end
        times = [time for time in random_views(data.num_frames["train"])[1].tolist() if time <= last]
    slabs = len(renderer.sampler.grid.occupied) if isinstance(renderer.sampler, OccupancySampler) else 1
    rays = _first_camera(record, CONSISTENCY_PIXELS, renderer.device).rays(0.0)
    findings = check_consistency(
        renderer, rays, torch.tensor(record.world.box), slabs=slabs, truth=truth, train_times=times
    )
    print("\n".join([f"{'check':20} {'verdict':13} {'value':>9} {'bound':>9}", *map(str, findings)]))
    listed = [{**vars(finding), "value": _finite(finding.value)} for finding in findings]
    write_json(folder / "consistency.json", {"checks": listed, **settings, **provenance()})
    print(f"consistency:   {folder / 'consistency.json'}")


def _exact_images(scene: AnalyticScene, renderer: Renderer, rays: Rays) -> Rendering:
    rgb, opacity, depth = render_exact(scene, rays, renderer.plain_background())
    return Rendering(rgb=rgb, opacity=opacity, depth=depth)


def _finite(value: float | None) -> float | None:
    """What JSON can hold: the order of what does not change at all is infinite."""
    return value if value is not None and math.isfinite(value) else None


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
