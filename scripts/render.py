"""Render a sequence of a run: python scripts/render.py run=runs/mutant path=orbit num_frames=60 format=mp4"""

import math
from collections.abc import Iterator
from pathlib import Path

import torch
from hydra_app import build, load_config, load_renderer, resolve_device, run_app
from omegaconf import DictConfig
from torch import Tensor
from tqdm import tqdm

from dnerf.cameras import Camera, fixed_path, look_at, orbit_path, spiral_path
from dnerf.checks import check_choice, check_positive
from dnerf.data.frames import Frames
from dnerf.renderer import Renderer
from dnerf.video import FORMATS, to_uint8, write_frames


def main(config: DictConfig) -> None:
    """Load the run, follow the path, write the sequence."""
    check_positive("num_frames", config.num_frames)
    check_positive("fps", config.fps)
    check_choice("format", config.format, FORMATS)
    saved = load_config(config.run)
    if config.data_root is not None:
        saved.data.root = config.data_root
    device = resolve_device(config.device)
    renderer = load_renderer(config.run, saved, device)
    frames = build(saved.data).frames(config.path.get("split", "test"))
    poses, own_times = _poses(config, frames)
    times = _times(config.time, len(poses), own_times)
    suffix = "" if config.format == "png" else f".{config.format}"
    output = Path(config.output or Path(config.run) / "renders" / f"{config.path.name}{suffix}")
    pictures = _pictures(renderer, frames, poses.to(device), times, config.resolution, config.chunk or saved.chunk)
    write_frames(tqdm(pictures, total=len(poses), unit="frame"), output, config.format, fps=config.fps)
    print(f"{len(poses)} frames: {output}")


def _pictures(
    renderer: Renderer, frames: Frames, poses: Tensor, times: list[float], resolution: int | None, chunk: int
) -> Iterator[Tensor]:
    intrinsics = frames.intrinsics
    if resolution is not None:
        check_positive("resolution", resolution)
        intrinsics = intrinsics.resized(resolution, round(resolution * intrinsics.height / intrinsics.width))
    for pose, time in zip(poses, times):
        camera = Camera(intrinsics, pose, frames.near, frames.far)
        yield to_uint8(renderer.render_image(camera, time, chunk=chunk).rgb)


def _poses(config: DictConfig, frames: Frames) -> tuple[Tensor, list[float] | None]:
    """Poses of the path, and the times that belong to them if the path has its own."""
    path, count = config.path, config.num_frames
    if path.name == "test":
        return frames.poses, frames.times.tolist()
    if path.name == "fixed":
        return fixed_path(count, _fixed_pose(path, frames)), None
    placed = {
        "radius": path.radius,
        "target": list(path.target),
        "turns": path.turns,
        "start_angle": math.radians(path.start_angle),
    }
    if path.name == "orbit":
        return orbit_path(count, elevation=math.radians(path.elevation), **placed), None
    low, high = (math.radians(angle) for angle in path.elevations)
    return spiral_path(count, elevations=(low, high), **placed), None


def _fixed_pose(path: DictConfig, frames: Frames) -> Tensor:
    if path.frame is not None:
        if not 0 <= path.frame < len(frames):
            raise ValueError(f"path.frame must be in 0..{len(frames) - 1}, got {path.frame}")
        return frames.poses[path.frame]
    azimuth, elevation = math.radians(path.azimuth), math.radians(path.elevation)
    around = math.cos(elevation)
    offset = (around * math.cos(azimuth), around * math.sin(azimuth), math.sin(elevation))
    return look_at([t + path.radius * o for t, o in zip(path.target, offset)], list(path.target))


def _times(time: str | float, count: int, own_times: list[float] | None) -> list[float]:
    if isinstance(time, str):
        check_choice("time", time, ("sweep", "pingpong"))
        if time == "sweep" and own_times is not None:
            return own_times
        phases = torch.arange(count, dtype=torch.float64)
        if time == "sweep":
            return (phases / max(count - 1, 1)).tolist()
        return (1 - (1 - 2 * phases / count).abs()).tolist()
    if not 0 <= time <= 1:
        raise ValueError(f"time must be sweep, pingpong or a number in [0, 1], got {time}")
    return [float(time)] * count


if __name__ == "__main__":
    run_app(main, "render")
