"""Follow points of a run and draw them over its images: python scripts/tracks.py run=runs/mutant

Writes the film, a still of its last image, a strip of four of its images, and the tracks (tracks.npz).
"""

from pathlib import Path

import numpy as np
import torch
from hydra_app import build, load_config, load_renderer, moved, resolve_device, run_app
from omegaconf import DictConfig
from reporting import camera_split
from tqdm import tqdm

from dnerf.core.cameras import Camera
from dnerf.core.checks import check_choice
from dnerf.data import DataSource
from dnerf.deformations import Deformation
from dnerf.deformations.jacobian import folding
from dnerf.evaluation import spread_indices
from dnerf.motion import Tracks, motion_model
from dnerf.visualization import render_tracks, visible_points, write_frames, write_png
from dnerf.visualization.video import FORMATS, check_film, check_fps

STRIP = 4
"""Images of the strip."""


def main(config: DictConfig) -> None:
    """Load the run, choose points, follow and draw them."""
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
    model = motion_model(renderer)
    if model is None:
        raise ValueError(f"run: the motion of {config.run} is unknown: its field changes without a deformation")
    data = build(saved.data)
    chunk = config.chunk or saved.chunk
    camera = _camera(config, data, device)
    points = visible_points(renderer, camera, config.start, config.spacing, chunk=chunk)
    times = torch.linspace(0, 1, config.num_frames).tolist()
    tracks, images = render_tracks(
        renderer, camera, points, config.start, times, trail=config.trail, every=config.every, chunk=chunk
    )
    frames = list(tqdm(images, total=-(-len(times) // config.every), unit="frame"))
    write_frames(frames, output, config.format, fps=config.fps)
    still = write_png(frames[-1], output.parent / f"{output.stem}_still.png")
    strip = torch.cat([frames[i] for i in spread_indices(len(frames), STRIP)], dim=1)
    write_png(strip, output.parent / f"{output.stem}_strip.png")
    arrays = {name: getattr(tracks, name).cpu().numpy() for name in ("times", "positions", "residuals")}
    np.savez_compressed(output.parent / f"{output.stem}.npz", **arrays)
    print(f"{points.shape[0]} tracks over {len(frames)} frames: {output}, {still}")
    print(f"residual: median {tracks.residuals.median():.2e}, largest {tracks.residuals.max():.2e} world units")
    if isinstance(model, Deformation):
        _print_folding(model, tracks)


def _print_folding(deformation: Deformation, tracks: Tracks) -> None:
    found = folding(deformation, tracks.positions, tracks.times[:, None].expand(tracks.positions.shape[:-1]))
    low, high = found.stretch
    print(
        f"smallest Jacobian determinant along the tracks: {found.least_determinant:.3f} (negative where space folds: "
        f"{found.share_folded:.3%}); smallest singular value {low:.2f} to {high:.2f} (middle 90 %; 1 is rigid)"
    )


def _camera(config: DictConfig, data: DataSource, device: torch.device) -> Camera:
    frames = data.frames(camera_split(config.split, data))
    if not 0 <= config.frame < len(frames):
        raise ValueError(f"frame must be in 0..{len(frames) - 1}, got {config.frame}")
    intrinsics = frames.intrinsics[config.frame]
    if config.resolution is not None:
        height = round(config.resolution * intrinsics.height / intrinsics.width)
        intrinsics = intrinsics.resized(config.resolution, height)
    return Camera(intrinsics, frames.poses[config.frame].to(device), frames.near, frames.far)


if __name__ == "__main__":
    run_app(main, "tracks")
