"""Scoring a model over time: a short film at even steps, against exact motion where it is known."""

import itertools
import math
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from dnerf.cameras import Camera
from dnerf.compositing import Rendering
from dnerf.data import render_exact
from dnerf.evaluation import MAX_PSNR
from dnerf.metrics import (
    depth_consistency,
    end_point_error,
    flicker,
    flow_outliers,
    psnr,
    temporal_psnr,
    track_errors,
    warping_error,
)
from dnerf.motion import MotionVectors, follow, motion_model, motion_vectors
from dnerf.renderer import Renderer
from dnerf.scenes import AnalyticScene, exact_flow, exact_tracks

MAX_RESIDUAL = 0.05
TRACK_STRIDE = 4
BEHIND_SURFACE = 1e-4


@dataclass(frozen=True)
class TemporalScores:
    """Scores of a film at a fixed camera and even steps of time; None where something is not known.

    Args:
        motion: "exact" (the scene's) or "model" (the model's own, which may be consistently wrong).
        num_frames: of the film.
        time_step: between frames.
        warping_error: mean squared, see `dnerf.metrics.warping_error`; of colours in [0, 1].
        true_warping_error: of the true film along the same motion: what interpolation alone costs.
        depth_consistency: relative, see `dnerf.metrics.depth_consistency`.
        flicker: see `dnerf.metrics.flicker`.
        true_flicker: of the true film.
        temporal_psnr: in dB, see `dnerf.metrics.temporal_psnr`.
        film_psnr: mean PSNR of the film's frames, in dB.
        flow_error: mean 2-D end-point error of the model's motion vectors, in pixels.
        flow_outliers: share off by more than 3 pixels and 5 %.
        still_flow_error: what standing still would score: the mean length of the true vectors, in pixels.
        scene_flow_error: mean 3-D end-point error, in world units.
        track_error: mean 3-D distance of tracks over the whole film, in world units.
        still_track_error: what standing still would score.
        track_accuracy: share of visible track points within 1, 2, 4, 8, 16 pixels of 256, averaged.
        found: share of visible pixels whose motion the model's inverse found.
    """

    motion: str
    num_frames: int
    time_step: float
    warping_error: float
    depth_consistency: float
    flicker: float
    found: float
    true_warping_error: float | None = None
    true_flicker: float | None = None
    temporal_psnr: float | None = None
    film_psnr: float | None = None
    flow_error: float | None = None
    flow_outliers: float | None = None
    still_flow_error: float | None = None
    scene_flow_error: float | None = None
    track_error: float | None = None
    still_track_error: float | None = None
    track_accuracy: float | None = None

    def as_dict(self) -> dict[str, object]:
        """Plain values, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class _Film:
    """A model's pictures (F, H, W, 3) at F times, and its own motion from each to the next with where it is found."""

    camera: Camera
    times: list[float]
    pictures: Tensor
    renderings: list[Rendering]
    motions: list[tuple[MotionVectors, Tensor]]


@torch.no_grad()
def evaluate_over_time(
    renderer: Renderer,
    camera: Camera,
    scene: AnalyticScene | None = None,
    *,
    num_frames: int = 25,
    chunk: int = 16384,
) -> TemporalScores:
    """Film the model with a fixed camera from t = 0 to 1 and score the film.

    With an analytic scene, motion, occlusion, tracks and true pictures are exact. Without one, the model's own motion
    and depth say where things go and what is hidden, and only consistency is scored: a model that believes in the wrong
    motion and paints accordingly is consistent too.

    Args:
        renderer: the model.
        camera: on its device.
        scene: what it has learnt, if that is known exactly.
        num_frames: of the film, at least 3.
        chunk: rays at a time.

    Raises:
        ValueError: for fewer than three frames.
    """
    if num_frames < 3:
        raise ValueError(f"num_frames must be at least 3, got {num_frames}")
    film = _shoot(renderer, camera, [i / (num_frames - 1) for i in range(num_frames)], chunk)
    common: dict[str, Any] = {"num_frames": num_frames, "time_step": film.times[1], "flicker": flicker(film.pictures)}
    if scene is not None:
        return _against_exact(renderer, scene, film, common)
    errors, depths, shares = [], [], []
    for i, (motion, found) in enumerate(film.motions):
        errors.append(warping_error(film.pictures[i], film.pictures[i + 1], motion.flow_2d, found))
        moved = (motion.positions + motion.flow_3d - camera.pose[:3, 3]).norm(dim=-1)
        depths.append(depth_consistency(moved, film.renderings[i + 1].depth, motion.flow_2d, found))
        shares.append(float(found.sum() / motion.visible.sum().clamp(min=1)))
    return TemporalScores(
        motion="model", warping_error=_mean(errors), depth_consistency=_mean(depths), found=_mean(shares), **common
    )


def _shoot(renderer: Renderer, camera: Camera, times: list[float], chunk: int) -> _Film:
    renderings = [renderer.render_image(camera, time, chunk=chunk) for time in times]
    model, motions = motion_model(renderer), []
    for i, (first, second) in enumerate(itertools.pairwise(renderings)):
        # Rays that meet nothing have depth 0, but hide nothing.
        hiding = torch.where(second.opacity < 0.5, torch.inf, second.depth)
        vectors = motion_vectors(
            model, camera, times[i], times[i + 1], first.depth, first.opacity, other_depth=hiding, chunk=chunk
        )
        motions.append((vectors, vectors.visible & (vectors.residual <= MAX_RESIDUAL)))
    return _Film(camera, times, torch.stack([r.rgb.clamp(0, 1) for r in renderings]), renderings, motions)


def _against_exact(renderer: Renderer, scene: AnalyticScene, film: _Film, common: dict[str, Any]) -> TemporalScores:
    camera, pictures = film.camera, film.pictures
    background = renderer.background(torch.zeros(1, 3, device=pictures.device))[0]
    truths = [render_exact(scene, camera.rays(time), background)[0] for time in film.times]
    truth = torch.stack(truths).reshape(pictures.shape)
    rows: list[dict[str, float]] = []
    for i, (vectors, found) in enumerate(film.motions):
        flow = exact_flow(scene, camera, film.times[i], camera, film.times[i + 1])
        exact = flow.vectors.to(pictures.dtype)
        both = found & (flow.owners >= 0)
        seen = both & flow.visible
        depth = film.renderings[i + 1].depth
        rows.append(
            {
                "warping_error": warping_error(pictures[i], pictures[i + 1], exact, flow.visible),
                "true_warping_error": warping_error(truth[i], truth[i + 1], exact, flow.visible),
                "depth_consistency": depth_consistency(flow.moved_depth.to(depth), depth, exact, flow.visible),
                "flow_error": end_point_error(vectors.flow_2d, exact, seen),
                "still_flow_error": end_point_error(torch.zeros_like(exact), exact, seen),
                "flow_outliers": flow_outliers(vectors.flow_2d, exact, seen),
                "scene_flow_error": end_point_error(vectors.flow_3d, (flow.moved - flow.positions).to(exact), both),
                "found": float(seen.sum() / flow.visible.sum().clamp(min=1)),
            }
        )
    means: dict[str, Any] = {name: _mean([row[name] for row in rows]) for name in rows[0]}
    return TemporalScores(
        motion="exact",
        true_flicker=flicker(truth),
        temporal_psnr=min(temporal_psnr(pictures, truth), MAX_PSNR),
        film_psnr=fmean(min(psnr(a, b), MAX_PSNR) for a, b in zip(pictures, truth)),
        **{**common, **_track_scores(renderer, camera, scene, film.times), **means},
    )


def _track_scores(renderer: Renderer, camera: Camera, scene: AnalyticScene, times: list[float]) -> dict[str, float]:
    """Tracks of surface points that start at true places; what the model's inverse loses counts as standing still."""
    rows, columns = torch.meshgrid(
        torch.arange(0, camera.intrinsics.height, TRACK_STRIDE),
        torch.arange(0, camera.intrinsics.width, TRACK_STRIDE),
        indexing="ij",
    )
    pixels = torch.stack([columns, rows], dim=-1).reshape(-1, 2).to(camera.pose.device)
    truth = exact_tracks(scene, [camera] * len(times), times, pixels)
    # Right on a surface rounding decides whether there is matter; the tracks' errors change by no more than this.
    inwards = torch.nn.functional.normalize(truth.positions[0] - camera.pose[:3, 3], dim=-1)
    start = (truth.positions[0] + BEHIND_SURFACE * inwards).to(camera.pose.dtype)
    found = follow(motion_model(renderer), start, times[0], torch.tensor(times, device=start.device))
    lost = (found.residuals > MAX_RESIDUAL)[..., None]
    tracks = torch.where(lost, start, found.positions)
    size = max(camera.intrinsics.height, camera.intrinsics.width)
    in_space = track_errors(tracks, truth.positions.to(tracks))
    still = track_errors(start.expand_as(tracks), truth.positions.to(tracks))
    in_picture = track_errors(camera.project(tracks)[0], truth.pixels.to(tracks), truth.visible, picture_size=size)
    return {
        "track_error": in_space.mean,
        "still_track_error": still.mean,
        "track_accuracy": in_picture.accuracy,
    }


def _mean(values: list[float]) -> float:
    """Mean of the numbers among values: frames in which nothing is seen twice have none."""
    kept = [value for value in values if not math.isnan(value)]
    return fmean(kept) if kept else 0.0
