"""Render a film of a run: python scripts/render.py run=runs/mutant path=orbit num_frames=60 format=mp4"""

import hashlib
import math
import os
import sys
from collections.abc import Callable, Sequence
from datetime import timedelta
from pathlib import Path

import torch
import torch.distributed
from hydra_app import build, load_config, load_renderer, moved, resolve_device, run_app
from omegaconf import DictConfig, ListConfig, OmegaConf
from reporting import camera_split
from torch import Tensor
from tqdm import tqdm

from dnerf.core.cameras import Intrinsics
from dnerf.core.checks import check_choice
from dnerf.data import DataSource, Frames, SyntheticData, render_exact
from dnerf.motion import motion_model
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import OccupancySampler
from dnerf.visualization import (
    FILM_FORMATS,
    FrameStore,
    Share,
    View,
    box_planes,
    check_outputs,
    fixed_path,
    is_empty,
    make_views,
    orbit_path,
    pingpong_times,
    pose_around,
    read_key_frames,
    render_frames_to,
    sequence_digest,
    slow_motion_times,
    spiral_path,
    sweep_times,
    write_films,
    write_plan,
)
from dnerf.visualization.video import check_fps

TIME_PATHS = ("sweep", "pingpong", "slow")


def main(config: DictConfig) -> None:
    """Load the run, follow the path, render what is missing, write the films."""
    outputs, formats = _listed(config.outputs), _listed(config.format)
    check_outputs(outputs)
    for format in formats:
        check_choice("format", format, FILM_FORMATS)
        check_fps(config.fps, format)
    saved = load_config(config.run)
    moved(saved, config.data_root)
    share = Share(int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)))
    device = resolve_device(config.device)
    renderer = load_renderer(config.run, saved, device)
    _subdivide(renderer, config.subdivision)
    data = build(saved.data)
    frames = data.frames(camera_split(config.path.split, data))
    views = _views(config, frames, data.box, device)
    chunk = config.chunk or saved.chunk
    facts = {
        "model": _fingerprint(config.run), "outputs": outputs, "chunk": chunk, "device": device.type,
        "subdivision": config.subdivision,
    }  # fmt: skip
    path = _output(config, formats)
    store = FrameStore(path.parent / f".{path.name}.{sequence_digest(views, facts)}", len(views))
    truth = _truth(data, frames, renderer, views, same_size=config.resolution is None) if "compare" in outputs else None
    if share.size > 1:
        torch.distributed.init_process_group("gloo", timeout=timedelta(days=7))
    if share.rank == 0:
        write_plan(store, views, facts)
    missing = [i for i in store.missing() if share.mine(i)]
    kept = len(views) - len(store.missing())
    if kept and share.rank == 0:
        print(f"{kept} of {len(views)} frames are there already")
    with tqdm(total=len(missing), unit="frame", disable=share.rank > 0, dynamic_ncols=True) as bar:
        render_frames_to(
            store, renderer, views, outputs, truth=truth, chunk=chunk, share=share, on_frame=lambda _: bar.update()
        )
    if share.size > 1:
        torch.distributed.barrier()
        torch.distributed.destroy_process_group()
    if share.rank == 0:
        for written in write_films(store, path, outputs, formats, fps=config.fps, views=views):
            print(f"{len(views)} frames: {written}")
        _warn(config.path, renderer, store, outputs, data.box)
        if not config.keep_frames:
            store.remove()


def _warn(path: DictConfig, renderer: Renderer, store: FrameStore, outputs: list[str], box: Tensor | None) -> None:
    """Say on standard error what a film does not show."""
    if is_empty(store):
        placed = [f"path.{name}={path[name]}" for name in ("radius", "target", "file") if name in path]
        where = f" ({', '.join(placed)})" if placed else ""
        print(
            f"warning: the film is empty: nothing is visible in any frame. Does the camera look at the box "
            f"{None if box is None else box.tolist()}? See path.radius and path.target{where}",
            file=sys.stderr,
        )
    if "motion" in outputs and motion_model(renderer) is None:
        print("warning: the motion of this model is unknown, its film is grey: it has no deformation", file=sys.stderr)


def _subdivide(renderer: Renderer, subdivision: int | None) -> None:
    """Cut the visible steps of images into so many parts; None for as many as the run says."""
    if subdivision is None:
        return
    if not isinstance(renderer.sampler, OccupancySampler):
        name = type(renderer.sampler).__name__
        raise ValueError(f"subdivision must be null for a run with a {name}, got {subdivision}")
    renderer.sampler.render_subdivision = subdivision


def _listed(value: str | ListConfig) -> list[str]:
    return [value] if isinstance(value, str) else list(value)


def _output(config: DictConfig, formats: list[str]) -> Path:
    path = Path(config.output or Path(config.run) / "renders" / config.path.name)
    return path.with_suffix("") if path.suffix[1:] in formats else path


def _fingerprint(run: str) -> str:
    digest = hashlib.sha256((Path(run) / "config.yaml").read_bytes())
    digest.update((Path(run) / "model.safetensors").read_bytes())
    return digest.hexdigest()


def _views(config: DictConfig, frames: Frames, box: Tensor | None, device: torch.device) -> list[View]:
    intrinsics = _resized(frames.intrinsics[0], config.resolution)
    angles: list[float | None] | None = None
    own_times: list[float] | None = None
    if config.path.name == "keyframes":
        keys = read_key_frames(config.path.file)
        try:
            poses, times, angles = keys.sample(config.fps)
        except ValueError as error:
            raise ValueError(f"{config.path.file}: {error}") from error
        own_times = times if "time" in keys.channels else None
    elif config.path.name == "test":
        poses, own_times = frames.poses, frames.times.tolist()
    else:
        poses = _poses(config, frames)
    times = own_times if config.time is None and own_times is not None else _times(config, len(poses))
    are_frames = config.path.name == "test"
    planes = [(frames.near, frames.far)] * len(poses) if are_frames or box is None else box_planes(poses, box)
    have_truth = are_frames and times is own_times
    return make_views(poses.to(device), times, intrinsics, planes, angles=angles, have_truth=have_truth)


def _resized(intrinsics: Intrinsics, resolution: int | ListConfig | None) -> Intrinsics:
    if resolution is None:
        return intrinsics
    if isinstance(resolution, int):
        return intrinsics.resized(resolution, round(resolution * intrinsics.height / intrinsics.width))
    angle = 2 * math.atan(0.5 * intrinsics.width / intrinsics.focal_x)
    return Intrinsics.from_angle(resolution[0], resolution[1], angle, intrinsics.pixel_origin)


def _poses(config: DictConfig, frames: Frames) -> Tensor:
    path, count = config.path, config.num_frames
    if path.name == "fixed":
        return fixed_path(count, _fixed_pose(path, frames))
    placed = {
        "radius": path.radius,
        "target": list(path.target),
        "turns": path.turns,
        "start_angle": math.radians(path.start_angle),
    }
    if path.name == "orbit":
        return orbit_path(count, elevation=math.radians(path.elevation), **placed)
    low, high = (math.radians(angle) for angle in path.elevations)
    return spiral_path(count, elevations=(low, high), **placed)


def _fixed_pose(path: DictConfig, frames: Frames) -> Tensor:
    if path.frame is not None:
        if not 0 <= path.frame < len(frames):
            raise ValueError(f"path.frame must be in 0..{len(frames) - 1}, got {path.frame}")
        return frames.poses[path.frame]
    angles = {name: math.radians(path[name]) for name in ("azimuth", "elevation")}
    return pose_around(list(path.target), radius=path.radius, **angles)


def _times(config: DictConfig, count: int) -> list[float]:
    time = "sweep" if config.time is None else config.time
    if not isinstance(time, str):
        if not 0 <= time <= 1:
            raise ValueError(f"time must be {', '.join(TIME_PATHS)} or a number in [0, 1], got {time}")
        return [float(time)] * count
    check_choice("time", time, TIME_PATHS)
    start, end = config.time_range
    if time == "slow":
        slow = OmegaConf.to_container(config.slow_motion)
        assert isinstance(slow, dict)
        return slow_motion_times(count, start=start, end=end, **{str(name): value for name, value in slow.items()})
    return (sweep_times if time == "sweep" else pingpong_times)(count, start, end)


def _truth(
    data: DataSource, frames: Frames, renderer: Renderer, views: Sequence[View], *, same_size: bool
) -> Callable[[View], Tensor]:
    """What gives the true image of each view: the data's own image, or the exact scene."""
    background = renderer.background(torch.zeros(1, 3, device=renderer.device))[0]
    if isinstance(data, SyntheticData):
        scene = data.scene.to(renderer.device)

        def exact(view: View) -> Tensor:
            shape = (view.camera.intrinsics.height, view.camera.intrinsics.width, 3)
            return render_exact(scene, view.camera.rays(view.time), background)[0].reshape(shape)

        return exact

    if not same_size or any(view.truth_index is None for view in views):
        raise ValueError(
            "outputs: compare needs true images: path=test at the data's own resolution, or an exact scene"
        )

    def image(view: View) -> Tensor:
        assert view.truth_index is not None
        return frames.image(view.truth_index, background.cpu())

    return image


if __name__ == "__main__":
    run_app(main, "render")
