"""Follow points of a run and draw them over its images: python scripts/tracks.py run=runs/mutant

Writes the film, a still of its last image, a strip of four of its images, and the tracks (tracks.npz).
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra_app import load_config, load_renderer, load_scene, resolve_device, run_app
from omegaconf import DictConfig
from tqdm import tqdm

from dnerf.core.cameras import Camera
from dnerf.core.checks import check_choice
from dnerf.core.geometry import box_planes
from dnerf.data import SceneRecord
from dnerf.data.normalization import IDENTITY
from dnerf.deformations import Deformation
from dnerf.deformations.inversion import folding
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
    if config.start is not None and not 0 <= config.start <= 1:
        raise ValueError(f"start must be in [0, 1], got {config.start}")
    saved = load_config(config.run)
    scene = load_scene(config.run)
    device = resolve_device(config.device)
    renderer = load_renderer(config.run, saved, device)
    model = motion_model(renderer)
    if model is None:
        raise ValueError(f"run: the motion of {config.run} is unknown: its field changes without a deformation")
    chunk = config.chunk or saved.chunk
    camera = _camera(config, scene, device)
    first, last = scene.times
    start = first if config.start is None else config.start
    points = visible_points(renderer, camera, start, config.spacing, chunk=chunk)
    times = torch.linspace(first, last, config.num_frames).tolist()
    tracks, images = render_tracks(
        renderer, camera, points, start, times, trail=config.trail, every=config.every, chunk=chunk
    )
    frames = list(tqdm(images, total=-(-len(times) // config.every), unit="frame"))
    write_frames(frames, output, config.format, fps=config.fps)
    still = write_png(frames[-1], output.parent / f"{output.stem}_still.png")
    strip = torch.cat([frames[i] for i in spread_indices(len(frames), STRIP)], dim=1)
    write_png(strip, output.parent / f"{output.stem}_strip.png")
    np.savez_compressed(output.parent / f"{output.stem}.npz", **_own_units(tracks, scene))
    print(f"{points.shape[0]} tracks over {len(frames)} frames: {output}, {still}")
    scale = scene.world.similarity.scale
    median, largest = tracks.residuals.median() / scale, tracks.residuals.max() / scale
    print(f"residual: median {median:.2e}, largest {largest:.2e}, in the data set's units")
    if isinstance(model, Deformation):
        _print_folding(model, tracks)


def _own_units(tracks: Tracks, scene: SceneRecord) -> dict[str, Any]:
    """Arrays of tracks in the data set's own units, and their times by its own clock beside those in [0, 1]."""
    world = scene.world
    own = tracks.positions.cpu()
    if world.similarity != IDENTITY:
        own = world.similarity.positions_from_world(own)
    times = tracks.times.cpu().numpy()
    return {
        "times": times, "data_times": world.clock.start + times.astype(np.float64) * world.clock.length,
        "positions": own.numpy(), "residuals": (tracks.residuals.cpu() / world.similarity.scale).numpy(),
    }  # fmt: skip


def _print_folding(deformation: Deformation, tracks: Tracks) -> None:
    found = folding(deformation, tracks.positions, tracks.times[:, None].expand(tracks.positions.shape[:-1]))
    low, high = found.stretch
    print(
        f"smallest Jacobian determinant along the tracks: {found.least_determinant:.3f} (negative where space folds: "
        f"{found.share_folded:.3%}); smallest singular value {low:.2f} to {high:.2f} (middle 90 %; 1 is rigid)"
    )


def _camera(config: DictConfig, scene: SceneRecord, device: torch.device) -> Camera:
    _, cameras = scene.split(config.split)
    if not 0 <= config.frame < len(cameras):
        raise ValueError(f"frame must be in 0..{len(cameras) - 1}, got {config.frame}")
    intrinsics, pose = cameras.intrinsics[config.frame], cameras.poses[config.frame]
    if config.resolution is not None:
        height = max(1, round(config.resolution * intrinsics.height / intrinsics.width))
        intrinsics = intrinsics.resized(config.resolution, height)
    return Camera(intrinsics, pose.to(device), *box_planes(pose[None], scene.world.box)[0])


if __name__ == "__main__":
    run_app(main, "tracks")
