"""Scores of a model over time: a short film at even steps, against exact motion where that is known."""

import itertools
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from dnerf.core.cameras import Camera
from dnerf.core.compositing import Rendering
from dnerf.data import render_exact
from dnerf.evaluation.images import psnr
from dnerf.evaluation.motion import end_point_error, flow_outliers, track_errors
from dnerf.evaluation.scores import MAX_PSNR
from dnerf.evaluation.temporal_metrics import depth_consistency, flicker, temporal_psnr, warping_error
from dnerf.motion import MAX_RESIDUAL, MotionModel, MotionVectors, follow, motion_model, motion_vectors
from dnerf.motion.vectors import OPAQUE, hiding_depth
from dnerf.rendering.renderer import Renderer
from dnerf.scenes import AnalyticScene, ExactFlow, exact_flow, exact_tracks

TRACK_STRIDE = 4
BEHIND_SURFACE = 1e-4
MODEL_SCORES = ("warping_error", "depth_consistency", "flicker", "found")  # What can be scored without the true motion


@dataclass(frozen=True)
class TemporalScores:
    """Scores of a film at a fixed camera and even steps of time; None is not measured, never perfect.

    `true_...` is what the exact scene scores as its own model: the floor that images and finite pixels set.
    """

    motion: str  # "exact" (the scene's) or "model" (the model's own, which may be consistently wrong)
    num_frames: int  # of the film
    time_step: float  # between frames
    flicker: float  # see `dnerf.evaluation.flicker`
    warping_error: float | None = None  # see `dnerf.evaluation.warping_error`; where the model is opaque
    depth_consistency: float | None = None  # relative, see `dnerf.evaluation.depth_consistency`, away from background
    found: float | None = None  # share of visible pixels whose motion the model's inverse found
    true_flicker: float | None = None  # of the true film
    true_warping_error: float | None = None
    true_depth_consistency: float | None = None
    temporal_psnr: float | None = None  # in dB, see `dnerf.evaluation.temporal_psnr`
    film_psnr: float | None = None  # mean PSNR of the film's frames, in dB
    flow_error: float | None = None  # mean 2-D end-point error of the model's motion vectors, in pixels
    true_flow_error: float | None = None  # of the exact scene's own motion, from the depth of its images
    still_flow_error: float | None = None  # mean length of the true vectors: what standing still would score
    flow_outliers: float | None = None  # share off by more than 3 pixels and 5 %
    scene_flow_error: float | None = None  # mean 3-D end-point error, in world units
    track_error: float | None = None  # mean 3-D distance of tracks over the whole film, in world units
    still_track_error: float | None = None  # what standing still would score
    track_accuracy: float | None = None  # share of visible track points within 1, 2, 4, 8, 16 pixels of 256, averaged

    def as_dict(self) -> dict[str, object]:
        """Plain values, ready for JSON: those that this kind of motion allows, None where not measured."""
        known = ("motion", "num_frames", "time_step", *MODEL_SCORES)
        return {name: value for name, value in asdict(self).items() if self.motion == "exact" or name in known}


@dataclass(frozen=True)
class _Film:
    """Images (F, H, W, 3) in [0, 1] at F times, and their motion (F - 1) from each to the next."""

    camera: Camera
    images: Tensor
    renderings: list[Rendering]
    vectors: list[MotionVectors]

    def opaque(self, index: int) -> Tensor:
        """Where an image shows a surface, (H, W) bool."""
        return self.renderings[index].opacity >= OPAQUE

    def steadiness(self, i: int, flow: Tensor, visible: Tensor, moved_depth: Tensor) -> dict[str, float]:
        """What needs no true motion to be scored between image i and the next, by a motion (H, W, 2) and its depth."""
        depth, opaque = self.renderings[i + 1].depth, self.opaque(i + 1)
        return {
            "warping_error": warping_error(self.images[i], self.images[i + 1], flow, visible),
            "depth_consistency": depth_consistency(moved_depth.to(depth), depth, flow, visible, second_opaque=opaque),
        }


@torch.no_grad()
def evaluate_over_time(
    renderer: Renderer, camera: Camera, scene: AnalyticScene | None = None, *, num_frames: int = 25, chunk: int = 16384
) -> TemporalScores:
    """Film the model with a fixed camera from t = 0 to 1 and score the film.

    With an analytic scene, motion, occlusion, tracks and true images are exact. Without one, the model's own motion and
    depth say where things go and what is hidden, and only consistency is scored: a model that believes in the wrong
    motion and paints accordingly is consistent too.

    Args:
        camera: on its device.
        scene: what it has learnt, if that is known exactly.
        num_frames: of the film, at least 3; ValueError otherwise.
    """
    if num_frames < 3:
        raise ValueError(f"num_frames must be at least 3, got {num_frames}")
    times = [i / (num_frames - 1) for i in range(num_frames)]
    model = motion_model(renderer)
    film = _shoot(lambda time: renderer.render_image(camera, time, chunk=chunk), model, camera, times, chunk)
    common: dict[str, Any] = {"num_frames": num_frames, "time_step": times[1], "flicker": flicker(film.images)}
    if scene is None:
        return TemporalScores(motion="model", **common, **_means([_own_row(film, i) for i in range(num_frames - 1)]))
    background = renderer.plain_background()
    truth = _shoot(lambda time: _exact_image(scene, camera, time, background), scene, camera, times, chunk)
    flows = [exact_flow(scene, camera, first, camera, second) for first, second in itertools.pairwise(times)]
    scores, floors = (_means([_exact_row(f, i, flow) for i, flow in enumerate(flows)]) for f in (film, truth))
    floor_names = ("warping_error", "depth_consistency", "flow_error")
    return TemporalScores(
        motion="exact", true_flicker=flicker(truth.images),
        temporal_psnr=min(temporal_psnr(film.images, truth.images), MAX_PSNR),
        film_psnr=fmean(min(psnr(a, b), MAX_PSNR) for a, b in zip(film.images, truth.images)),
        **common, **scores, **{f"true_{name}": floors[name] for name in floor_names},
        **_track_scores(model, camera, scene, times, flows[0]),
    )  # fmt: skip


def _shoot(
    render: Callable[[float], Rendering], model: MotionModel | None, camera: Camera, times: list[float], chunk: int
) -> _Film:
    renderings = [render(time) for time in times]
    vectors = [
        motion_vectors(
            model, camera, times[i], times[i + 1], first.depth, first.opacity,
            other_depth=hiding_depth(second.depth, second.opacity), chunk=chunk,
        )
        for i, (first, second) in enumerate(itertools.pairwise(renderings))
    ]  # fmt: skip
    return _Film(camera, torch.stack([image.rgb.clamp(0, 1) for image in renderings]), renderings, vectors)


def _exact_image(scene: AnalyticScene, camera: Camera, time: float, background: Tensor) -> Rendering:
    size = (camera.intrinsics.height, camera.intrinsics.width)
    rgb, opacity, depth = render_exact(scene, camera.rays(time), background)
    return Rendering(rgb=rgb.reshape(*size, 3), opacity=opacity.reshape(size), depth=depth.reshape(size))


def _own_row(film: _Film, i: int) -> dict[str, float]:
    """Scores of a pair of frames by the model's own motion; NaN where nothing is visible in both."""
    vectors = film.vectors[i]
    found = vectors.visible & vectors.found
    moved = (vectors.positions + vectors.flow_3d - film.camera.pose[:3, 3]).norm(dim=-1)
    found_share = float(found.sum() / vectors.visible.sum())
    return {**film.steadiness(i, vectors.flow_2d, found, moved), "found": found_share}


def _exact_row(film: _Film, i: int, flow: ExactFlow) -> dict[str, float]:
    """Scores of a pair of frames by the scene's motion; NaN where the film shows nothing of it."""
    vectors, exact = film.vectors[i], flow.vectors.to(film.images)
    both = vectors.visible & vectors.found & (flow.owners >= 0)
    followed = both & flow.visible
    return {
        **film.steadiness(i, exact, flow.visible & film.opaque(i), flow.moved_depth),
        "flow_error": end_point_error(vectors.flow_2d, exact, followed),
        "still_flow_error": end_point_error(torch.zeros_like(exact), exact, followed),
        "flow_outliers": flow_outliers(vectors.flow_2d, exact, followed),
        "scene_flow_error": end_point_error(vectors.flow_3d, (flow.moved - flow.positions).to(exact), both),
        "found": float(followed.sum() / flow.visible.sum()),
    }


def _track_scores(
    model: MotionModel | None, camera: Camera, scene: AnalyticScene, times: list[float], flow: ExactFlow
) -> dict[str, Any]:
    """Tracks of surface points that start at true places; what the model's inverse loses counts as standing still."""
    rows, columns = (flow.owners[::TRACK_STRIDE, ::TRACK_STRIDE] >= 0).nonzero().unbind(-1)
    if model is None or not len(rows):
        return {}
    pixels = TRACK_STRIDE * torch.stack([columns, rows], dim=-1)
    truth = exact_tracks(scene, [camera] * len(times), times, pixels)
    # Right on a surface rounding decides on which side a point is; the tracks' errors change by no more than this.
    inwards = torch.nn.functional.normalize(truth.positions[0] - camera.pose[:3, 3], dim=-1)
    start = (truth.positions[0] + BEHIND_SURFACE * inwards).to(camera.pose.dtype)
    found = follow(model, start, times[0], torch.tensor(times, device=start.device))
    lost = (found.residuals > MAX_RESIDUAL)[..., None]
    tracks = torch.where(lost, start, found.positions)
    size = max(camera.intrinsics.height, camera.intrinsics.width)
    in_space = track_errors(tracks, truth.positions.to(tracks))
    still = track_errors(start.expand_as(tracks), truth.positions.to(tracks))
    in_image = track_errors(camera.project(tracks)[0], truth.pixels.to(tracks), truth.visible, image_size=size)
    scores = {"track_error": in_space.mean, "still_track_error": still.mean, "track_accuracy": in_image.accuracy}
    return {name: _mean([value]) for name, value in scores.items()}


def _means(rows: list[dict[str, float]]) -> dict[str, Any]:
    return {name: _mean([row[name] for row in rows]) for name in rows[0]}


def _mean(values: list[float]) -> float | None:
    """Mean of the numbers among values, None if there are none: frames in which nothing is visible twice have none."""
    kept = [value for value in values if not math.isnan(value)]
    return fmean(kept) if kept else None
