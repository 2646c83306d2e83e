"""The views of a film: where its camera goes and what time it is, from the settings and what the run knows."""

import math
import sys
from collections.abc import Sequence

import torch
from omegaconf import DictConfig, ListConfig
from torch import Tensor

from dnerf.core.cameras import Intrinsics
from dnerf.core.checks import check_choice
from dnerf.core.geometry import box_planes
from dnerf.data import SceneRecord
from dnerf.visualization import (
    Surroundings,
    View,
    film_times,
    fixed_path,
    make_views,
    pose_around,
    read_key_frames,
    spiral_path,
)

ROUNDING = 1e-6  # of the clock, beyond either end of what there is


def film_views(config: DictConfig, scene: SceneRecord, device: torch.device) -> list[View]:
    """Views of the path that the settings describe; what they leave open follows the training cameras.

    Lengths in the settings are in the data set's own units, and so are files of key frames.

    Raises:
        ValueError: naming the setting, or the file and its entry.
    """
    name = config.path.name
    makers = {
        "keyframes": _key_frames, "test": _own_cameras, "fixed": _fixed, "orbit": _around, "spiral": _around,
    }  # fmt: skip
    check_choice("path.name", name, tuple(makers))
    poses, lenses, own_times = makers[name](config, scene)
    times = own_times if config.time is None and own_times is not None else _times(config, scene, len(poses))
    _warn_of_times(times, scene)
    planes = box_planes(poses, scene.world.box)
    if name == "test":
        near, far = scene.world.planes
        planes = [(a if near is None else near, b if far is None else far) for a, b in planes]
    have_truth = name == "test" and times is own_times
    return make_views(poses.float().to(device), times, lenses, planes, have_truth=have_truth)


Path = tuple[Tensor, list[Intrinsics], list[float] | None]  # poses, lenses and the path's own times


def _around(config: DictConfig, scene: SceneRecord) -> Path:
    path, around = config.path, _followed(config, scene)
    target, radius = _target(path, scene), _length(path.radius, scene)
    if path.name == "orbit":
        elevations = (around.elevation,) * 2 if path.elevation is None else (math.radians(path.elevation),) * 2
    else:
        low, high = around.elevations if path.elevations is None else map(math.radians, path.elevations)
        elevations = low, high
    start, sway, turns = 0.0, None, path.turns
    if turns is None:
        turns = 1.0 if path.name == "orbit" else 2.0
        if (arc := around.sway()) is not None:
            start, sway = arc
            degrees = f"{math.degrees(2 * sway):.0f} degrees"
            print(f"training cameras stand within {degrees}: the film sways among them, path.turns=1 goes round")
    poses = spiral_path(
        config.num_frames, radius=around.radius if radius is None else radius, elevations=elevations,
        target=around.target if target is None else target, turns=turns, sway=sway,
        start_angle=start if path.start_angle is None else math.radians(path.start_angle),
    )  # fmt: skip
    return poses, [_resized(around.intrinsics, config.resolution)] * len(poses), None


def _fixed(config: DictConfig, scene: SceneRecord) -> Path:
    path = config.path
    if path.frame is not None:
        _, cameras = scene.split(path.split)
        if not 0 <= path.frame < len(cameras):
            raise ValueError(f"path.frame must be in 0..{len(cameras) - 1}, got {path.frame}")
        pose, lens = cameras.poses[path.frame], cameras.intrinsics[path.frame]
    else:
        around = _followed(config, scene)
        target, radius = _target(path, scene), _length(path.radius, scene)
        pose, lens = (
            pose_around(
                around.target if target is None else target, radius=around.radius if radius is None else radius,
                azimuth=around.azimuth if path.azimuth is None else math.radians(path.azimuth),
                elevation=around.elevation if path.elevation is None else math.radians(path.elevation),
            ),
            around.intrinsics,
        )  # fmt: skip
    poses = fixed_path(config.num_frames, pose)
    return poses, [_resized(lens, config.resolution)] * len(poses), None


def _own_cameras(config: DictConfig, scene: SceneRecord) -> Path:
    _, cameras = scene.split(config.path.split)
    return cameras.poses, [_resized(lens, config.resolution) for lens in cameras.intrinsics], cameras.times.tolist()


def _key_frames(config: DictConfig, scene: SceneRecord) -> Path:
    around = _followed(config, scene)
    keys = read_key_frames(config.path.file).in_world(scene.world.similarity)
    placed = {"target": around.target, "radius": (around.radius,), "elevation": (math.degrees(around.elevation),)}
    try:
        poses, times, angles = keys.sample(config.fps, placed)
    except ValueError as error:
        raise ValueError(f"{config.path.file}: {error}") from error
    lens = _resized(around.intrinsics, config.resolution)
    lenses = [
        lens if angle is None else Intrinsics.from_angle(lens.width, lens.height, angle, lens.pixel_origin)
        for angle in angles
    ]
    return poses, lenses, times if "time" in keys.channels else None


def _followed(config: DictConfig, scene: SceneRecord) -> Surroundings:
    """Where the cameras stand from which a film takes what the settings leave open."""
    return Surroundings.of(scene.split(config.path.split or "train")[1])


def _target(path: DictConfig, scene: SceneRecord) -> list[float] | None:
    if path.target is None:
        return None
    own = torch.tensor(list(path.target), dtype=torch.float64)
    return scene.world.similarity.positions_to_world(own).tolist()


def _length(own: float | None, scene: SceneRecord) -> float | None:
    return None if own is None else own * scene.world.similarity.scale


def _resized(intrinsics: Intrinsics, resolution: int | ListConfig | None) -> Intrinsics:
    if resolution is None:
        return intrinsics
    if isinstance(resolution, int):
        return intrinsics.resized(resolution, max(1, round(resolution * intrinsics.height / intrinsics.width)))
    angle = 2 * math.atan(0.5 * intrinsics.width / intrinsics.focal_x)
    return Intrinsics.from_angle(resolution[0], resolution[1], angle, intrinsics.pixel_origin)


def _times(config: DictConfig, scene: SceneRecord, count: int) -> list[float]:
    clock = scene.world.clock if config.clock == "data" else None
    own = config.time_range is not None
    limits, time = tuple(config.time_range) if own else scene.times, "sweep" if config.time is None else config.time
    return film_times(count, time, limits, clock if own else None, clock)


def _warn_of_times(times: Sequence[float], scene: SceneRecord) -> None:
    first, last = scene.times
    if min(times) < first - ROUNDING or max(times) > last + ROUNDING:
        print(
            f"warning: the film shows times {min(times):.4g} to {max(times):.4g}, training frames are from {first:.4g} "
            f"to {last:.4g}: beyond them nothing was learnt",
            file=sys.stderr,
        )
