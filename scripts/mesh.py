"""A run's surface as an animated glTF, or a PLY or OBJ file for each frame: python scripts/mesh.py run=runs/mutant"""

import sys
import time
from pathlib import Path

import torch
from hydra_app import load_config, load_renderer, load_scene, resolve_device, run_app
from omegaconf import DictConfig

from dnerf.core.checks import check_choice
from dnerf.fields import RadianceField, TimeDependence
from dnerf.meshing import FORMATS, Mesh, extract_surface, mesh_through_time, share_on_box, write_gltf, write_meshes

CUT = 1e-3  # share of the surface on the box's sides from which on a line says so


def main(config: DictConfig) -> None:
    """Load the run, find its surface, move it through time and write it."""
    formats = [config.format] if isinstance(config.format, str) else list(config.format)
    for format in formats:
        check_choice("format", format, ("glb", *FORMATS))
    if config.time is not None and not 0 <= config.time <= 1:
        raise ValueError(f"time must be in [0, 1], got {config.time}")
    saved, scene = load_config(config.run), load_scene(config.run)
    renderer = load_renderer(config.run, saved, resolve_device(config.device))
    begun = time.perf_counter()
    start = sum(scene.times) / 2 if config.time is None else config.time
    on_box: list[float] = []

    def extract(field: RadianceField, time: float) -> Mesh:
        mesh = extract_surface(
            field, time, box=scene.world.box, resolution=config.resolution, level=config.level,
            min_share=config.min_share, close_gaps=config.close_gaps,
        )  # fmt: skip
        on_box.append(share_on_box(mesh, scene.world.box))
        return mesh

    count = config.num_frames
    times = torch.linspace(*scene.times, count) if count > 1 else torch.tensor([start])
    moving = mesh_through_time(renderer.field, times, extract, start=start)
    if moving is None and "glb" in formats:
        raise ValueError(
            "format must be ply or obj: without a deformation each frame has its own triangles, no animation"
        )
    if moving is not None:
        print(moving.summary())
        canonical = getattr(renderer.field, "canonical", None)
        if isinstance(canonical, TimeDependence) and not canonical.is_static:
            print(f"the canonical field changes with time: shape and colours are those of time {start:.3g}")
    folder, similarity = Path(config.output or Path(config.run) / "meshes"), scene.world.similarity
    for format in formats:
        if format == "glb" and moving is not None:
            path = write_gltf(
                moving, folder / "mesh.glb", fps=config.fps, every=config.key_every, lit=config.lit,
                interpolation=config.interpolation, similarity=similarity,
            )  # fmt: skip
        else:
            own = (extract(renderer.field, time) for time in times.tolist())
            frames = own if moving is None else map(moving.frame, range(len(moving.times)))
            path = write_meshes(frames, folder / format, format, similarity=similarity)
        print(f"{format}: {path}")
    if max(on_box) > CUT:
        print(
            f"warning: {max(on_box):.1%} of the surface lies on the sides of the run's box, which cuts it; "
            "a larger data.box in training would not",
            file=sys.stderr,
        )
    print(f"{time.perf_counter() - begun:.1f} s")


if __name__ == "__main__":
    run_app(main, "mesh")
