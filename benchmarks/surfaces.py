"""How right surfaces are: signed distances trained on exact scenes, whose surfaces are known."""

from collections.abc import Sequence
from itertools import product
from statistics import median
from typing import Any

import torch
from torch import Tensor

from benchmarks.runs import run_training, warm_up
from benchmarks.scenes import scene_overrides
from benchmarks.suite import Row, Settings, SuiteResult, Table
from dnerf.core.cameras import Camera
from dnerf.core.geometry import safe_normalize
from dnerf.meshing import Mesh, extract_surface
from dnerf.rendering.renderer import Renderer
from dnerf.scenes import AnalyticScene, make_scene
from dnerf.scenes.exact_motion import first_surfaces, is_visible
from dnerf.visualization.frame_outputs import normals_image

QUICK = {"kinds": {"static": ["experiment=sdf"]}, "seconds": 5, "seeds": [0], "resolution": 40, "lattice": 48}
Kind = tuple[str, list[str], int]  # scene, overrides, seed
AT_ONCE = 1024  # points whose nearest vertices are sought together
NUM_VIEWS = 20  # of the training frames, that may see a place
LIFT = 1e-3  # world units, of places above their surface, which then does not hide them


def run(settings: Settings) -> SuiteResult:
    """Train every kind of model on its scene with every seed, and compare its mesh and its images of normals."""
    options = {**settings.options, **(QUICK if settings.quick else {})}
    kinds = [(scene, words, seed) for (scene, words), seed in product(options["kinds"].items(), options["seeds"])]
    warm_up(settings.train_command, _overrides(settings, options, kinds[0]), settings.work_dir / "warm_up")
    rows = [_measured(settings, options, kind) for kind in kinds]
    return SuiteResult(
        title="Surfaces of signed distances against exact ones",
        summary=f"Models are trained for {options['seconds']:g} s on exact scenes, {options['resolution']} x "
        f"{options['resolution']} pixels. Meshes are of time {options['time']:g}, of {options['lattice']} cells along "
        "the box. Bodies of these scenes absorb light 1 / 80 of a unit deep: images show an end no more exactly.",
        tables=[
            Table(
                "Surfaces", rows, "off: mean distance of the mesh's vertices from the true surface. missed: of true "
                "points from the nearest vertex, which is up to a third of a cell too much. chamfer: their mean. All "
                "in percent of the longest side, where some camera sees the true surface; seen: of the vertices. "
                "volume: how much larger, unseen sides included. normals: median angle in held-out images, in degrees.",
            )
        ],
    )  # fmt: skip


def _overrides(settings: Settings, options: dict[str, Any], kind: Kind) -> list[str]:
    scene, words, seed = kind
    return [
        *words, *scene_overrides(scene, options["resolution"], None, settings.quick), f"seed={seed}",
        f"trainer.max_seconds={options['seconds']}", "trainer.num_steps=1000000000", f"device={settings.device}",
        f"evaluate_frames={options['frames']}",
    ]  # fmt: skip


def _measured(settings: Settings, options: dict[str, Any], kind: Kind) -> Row:
    scene, words, seed = kind
    folder = settings.work_dir / f"{scene}-{'-'.join(words)}-seed{seed}".replace("=", "_")
    trained = run_training(settings.train_command, _overrides(settings, options, kind), folder)
    model, exact, time = settings.finished(str(folder)), make_scene(scene), options["time"]
    renderer, frames = model["renderer"].eval().cpu(), model["data"].frames("test")
    found, true = (
        extract_surface(field, time, box=exact.box, resolution=options["lattice"]) for field in (renderer.field, exact)
    )
    size = float((true.vertices.amax(0) - true.vertices.amin(0)).max()) / 100
    views = model["data"].frames("train")
    cameras = [views.camera(i) for i in range(0, len(views), max(1, len(views) // NUM_VIEWS))]
    seen, of_true = (_seen(exact, x.vertices, cameras, time) for x in (found, true))
    off = float(exact.distance(found.vertices, torch.full_like(found.vertices[:, 0], time))[seen].abs().mean()) / size
    points = true.vertices[of_true]
    missed = sum(_nearest(part, found.vertices) * len(part) for part in points.split(AT_ONCE)) / len(points) / size
    numbers = range(0, len(frames), max(1, len(frames) // options["frames"]))
    angles = [_angle(renderer, exact, frames.camera(i), float(frames.times[i])) for i in numbers]
    return {
        "scene": scene, "overrides": " ".join(words), "seed": seed, "steps": trained.num_steps, "psnr": trained.psnr,
        "seen_%": 100 * float(seen.float().mean()), "off_%": off, "missed_%": missed, "chamfer_%": (off + missed) / 2,
        "volume_%": 100 * (_volume(found) / _volume(true) - 1), "normals_deg": median(angles),
    }  # fmt: skip


def _seen(scene: AnalyticScene, points: Tensor, cameras: Sequence[Camera], time: float) -> Tensor:
    """Of which points (N, 3) some camera sees the nearest place of the true surface, (N,) bool."""
    distances, slopes = _slopes(scene, points, torch.full_like(points[:, 0], time))
    feet = points - (distances - LIFT)[:, None] * slopes
    return torch.stack([is_visible(scene, camera, time, feet) for camera in cameras]).any(0)


def _slopes(scene: AnalyticScene, points: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """The true distance (N,) of points (N, 3), and its unit gradient (N, 3)."""
    with torch.enable_grad():
        points = points.detach().requires_grad_()
        distances = scene.distance(points, times)
        (gradient,) = torch.autograd.grad(distances.sum(), points)
    return distances.detach(), safe_normalize(gradient)


def _nearest(points: Tensor, vertices: Tensor) -> float:
    return float(torch.cdist(points, vertices).amin(1).mean())


def _volume(mesh: Mesh) -> float:
    a, b, c = mesh.vertices.double()[mesh.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum()) / 6


def _angle(renderer: Renderer, scene: AnalyticScene, camera: Any, time: float) -> float:
    """The median angle, in degrees, between normals of an image and of the first surfaces behind its pixels."""
    shown = normals_image(renderer, camera, time).reshape(-1, 3)
    rays = camera.rays(time)
    places = first_surfaces(scene, rays).positions
    kept = (places.isfinite().all(-1) & shown.any(-1)).nonzero()[:, 0]
    _, slopes = _slopes(scene, places[kept], rays.times[kept])
    cosines = (slopes * shown[kept]).sum(-1).clamp(-1, 1)
    return float(cosines.acos().rad2deg().median())
