"""Follow material points of a run and draw them over its pictures: python scripts/tracks.py run=runs/mutant

Writes the sequence, a still of its last picture, a strip of four of its pictures, the tracks (tracks.npz) and, for runs
on an exact scene, the 3-D end-point error of the recovered motion (motion.json).
"""

from pathlib import Path

import numpy as np
import torch
from hydra_app import build, load_config, load_renderer, moved, resolve_device, run_app
from omegaconf import DictConfig
from torch import Tensor
from tqdm import tqdm

from dnerf.benchmarks.endpoint_rows import endpoint_rows
from dnerf.cameras import Camera
from dnerf.checks import check_choice
from dnerf.data import SyntheticData
from dnerf.deformations import Deformation
from dnerf.deformations.folding import folding
from dnerf.evaluation import spread_indices
from dnerf.fields import DeformedField
from dnerf.files import write_json
from dnerf.motion import motion_model
from dnerf.motion_search import has_unknown_motion
from dnerf.renderer import Renderer
from dnerf.seen_matter import seen_matter
from dnerf.tracks import render_tracks, seen_points
from dnerf.video import FORMATS, check_film, check_fps, write_frames, write_png

STRIP = 4
"""Pictures of the strip."""


def main(config: DictConfig) -> None:
    """Load the run, choose and follow points, draw, and measure where the truth is known."""
    check_choice("format", config.format, FORMATS)
    check_fps(config.fps, config.format)
    suffix = "" if config.format == "png" else f".{config.format}"
    output = Path(config.output or Path(config.run) / "renders" / f"tracks{suffix}")
    output = output if output.suffix else output.with_suffix(suffix)
    if suffix:
        check_film(output, config.format)
    if not 0 <= config.start <= 1:
        raise ValueError(f"start must be in [0, 1], got {config.start}")
    saved = load_config(config.run)
    moved(saved, config.data_root)
    device = resolve_device(config.device)
    renderer = load_renderer(config.run, saved, device)
    data = build(saved.data)
    chunk = config.chunk or saved.chunk
    camera = _camera(config, data, device)
    points = seen_points(renderer, camera, config.start, config.spacing, chunk=chunk)
    times = torch.linspace(0, 1, config.num_frames).tolist()
    tracks, pictures = render_tracks(
        renderer, camera, points, config.start, times, trail=config.trail, every=config.every, chunk=chunk
    )
    frames = list(tqdm(pictures, total=-(-len(times) // config.every), unit="frame"))
    write_frames(frames, output, config.format, fps=config.fps)
    still = write_png(frames[-1], output.parent / f"{output.stem}_still.png")
    strip = torch.cat([frames[i] for i in spread_indices(len(frames), STRIP)], dim=1)
    write_png(strip, output.parent / f"{output.stem}_strip.png")
    arrays = {name: getattr(tracks, name).cpu().numpy() for name in ("times", "positions", "residuals")}
    np.savez_compressed(output.parent / f"{output.stem}.npz", **arrays)
    print(f"{points.shape[0]} tracks over {len(frames)} frames: {output}, {still}")
    print(f"residual: median {tracks.residuals.median():.2e}, largest {tracks.residuals.max():.2e} world units")
    if has_unknown_motion(renderer):
        print("note: this model shows matter whose motion it does not know, see motion_search in docs/flow.md")
    model = motion_model(renderer)
    if isinstance(model, Deformation):
        moments = tracks.times[:, None].expand(tracks.positions.shape[:-1])
        _print_folding(model, tracks.positions, moments, "along the tracks")
    if isinstance(renderer.field, DeformedField) and config.matter_rays:
        frames = data.frames("train").to(device)
        seen = seen_matter(renderer, frames, config.matter_rays, torch.Generator(device).manual_seed(0))
        if len(seen.times):
            where = f"in matter of training pixels ({len(seen.times):,} places)"
            _print_folding(renderer.field.modelled_motion, seen.positions, seen.times, where)
    if isinstance(data, SyntheticData):
        _measure(renderer, data, Path(config.run) / "motion.json", device)


def _print_folding(deformation: Deformation, positions: Tensor, times: Tensor, where: str) -> None:
    found = folding(deformation, positions, times)
    low, high = found.stretch
    print(
        f"smallest Jacobian determinant {where}: {found.least_determinant:.3f} (negative where space folds: "
        f"{found.share_folded:.3%}); smallest singular value {low:.2f} to {high:.2f} (middle 90 %; 1 is rigid)"
    )


def _camera(config: DictConfig, data: object, device: torch.device) -> Camera:
    frames = data.frames(config.split)  # type: ignore[attr-defined]
    if not 0 <= config.frame < len(frames):
        raise ValueError(f"frame must be in 0..{len(frames) - 1}, got {config.frame}")
    intrinsics = frames.intrinsics
    if config.resolution is not None:
        height = round(config.resolution * intrinsics.height / intrinsics.width)
        intrinsics = intrinsics.resized(config.resolution, height)
    return Camera(intrinsics, frames.poses[config.frame].to(device), frames.near, frames.far)


def _measure(renderer: Renderer, data: SyntheticData, path: Path, device: torch.device) -> None:
    rows = endpoint_rows(motion_model(renderer), data.scene.to(device))
    print(f"{'time':>5}  {'moved':>7}  {'mean error':>10}  {'median':>7}  {'residual':>8}")
    for row in rows:
        print(
            f"{row['time']:>5.2f}  {row['moved']:>7.4f}  {row['mean_error']:>10.4f}  {row['median_error']:>7.4f}  "
            f"{row['residual']:>8.1e}"
        )
    write_json(path, {"end_point_error": rows})
    print(f"end-point errors: {path}")


if __name__ == "__main__":
    run_app(main, "tracks")
