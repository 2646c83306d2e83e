"""Render a film of a run: python scripts/render.py run=runs/mutant path=orbit num_frames=60 format=mp4"""

import hashlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from film_views import film_views
from hydra_app import build, load_config, load_renderer, load_scene, moved, resolve_device, run_app
from omegaconf import DictConfig, ListConfig
from torch import Tensor
from tqdm import tqdm

from dnerf.core.checks import check_choice
from dnerf.data import SceneRecord, SyntheticData, render_exact
from dnerf.motion import motion_model
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import OccupancySampler, SphereTracingSampler
from dnerf.visualization import (
    FILM_FORMATS,
    FrameStore,
    View,
    check_outputs,
    empty_frames,
    render_frames_to,
    sequence_digest,
    write_films,
    write_plan,
)
from dnerf.visualization.video import check_fps


def main(config: DictConfig) -> None:
    """Load the run, follow the path, render what is missing, write the films."""
    outputs, formats = _listed(config.outputs), _listed(config.format)
    check_outputs(outputs)
    for format in formats:
        check_choice("format", format, FILM_FORMATS)
        check_fps(config.fps, format)
    saved = load_config(config.run)
    scene = load_scene(config.run)
    device = resolve_device(config.device)
    renderer = load_renderer(config.run, saved, device)
    _subdivide(renderer, config.subdivision)
    if config.surface:
        traced = SphereTracingSampler(scene.world.box)
        renderer = Renderer(renderer.field, traced, renderer.background).to(device).eval()
    views = film_views(config, scene, device)
    truth = None
    if "compare" in outputs:
        moved(saved, config.data_root)
        truth = _truth(saved, scene, config, renderer, views)
    chunk = config.chunk or saved.chunk
    facts = {
        "model": _fingerprint(config.run), "outputs": outputs, "chunk": chunk, "device": device.type,
        "subdivision": config.subdivision, "surface": config.surface, "world": asdict(scene.world.similarity),
    }  # fmt: skip
    path = _output(config, formats)
    store = FrameStore(path.parent / f".{path.name}.{sequence_digest(views, facts)}", len(views))
    write_plan(store, views, facts)
    missing = store.missing()
    if len(missing) < len(views):
        print(f"{len(views) - len(missing)} of {len(views)} frames are there already")
    with tqdm(total=len(missing), unit="frame", dynamic_ncols=True) as bar:
        render_frames_to(
            store, renderer, views, outputs, truth=truth, chunk=chunk, on_frame=lambda _: bar.update(),
            unit=scene.world.similarity.scale,
        )  # fmt: skip
    for written in write_films(store, path, outputs, formats, fps=config.fps, views=views, world=scene.world):
        print(f"{len(views)} frames: {written}")
    _warn(config.path, renderer, store, outputs, scene)
    if not config.keep_frames:
        store.remove()


def _warn(path: DictConfig, renderer: Renderer, store: FrameStore, outputs: list[str], scene: SceneRecord) -> None:
    """Say on standard error what a film does not show."""
    empty = empty_frames(store)
    if len(empty) == store.num_frames:
        placed = [f"path.{name}={path[name]}" for name in ("radius", "target", "file") if path.get(name) is not None]
        where = f" ({', '.join(placed)})" if placed else ""
        box = scene.world.similarity.box_from_world(scene.world.box).tolist()
        print(
            f"warning: the film is empty: nothing is visible in any frame. Does the camera look at the box {box}? "
            f"See path.radius and path.target{where}",
            file=sys.stderr,
        )
    elif empty:
        listed = ", ".join(map(str, empty[:8])) + (", ..." if len(empty) > 8 else "")
        print(f"warning: {len(empty)} of {store.num_frames} frames show nothing: {listed}", file=sys.stderr)
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


def _truth(
    saved: DictConfig, scene: SceneRecord, config: DictConfig, renderer: Renderer, views: Sequence[View]
) -> Callable[[View], Tensor]:
    """What gives the true image of each view: the data's own image, or the exact scene."""
    data = build(saved.data)
    data.settle(scene.world)
    background = renderer.plain_background()
    if isinstance(data, SyntheticData):
        model = data.scene.to(renderer.device)

        def exact(view: View) -> Tensor:
            shape = (view.camera.intrinsics.height, view.camera.intrinsics.width, 3)
            return render_exact(model, view.camera.rays(view.time), background)[0].reshape(shape)

        return exact

    if config.resolution is not None or any(view.truth_index is None for view in views):
        raise ValueError(
            "outputs: compare needs true images: path=test at the data's own resolution, or an exact scene"
        )
    frames = data.frames(scene.split(config.path.split)[0])
    if len(frames) != len(views):
        raise ValueError(f"outputs: compare needs the images of all {len(views)} cameras, got {len(frames)} of them")

    def image(view: View) -> Tensor:
        assert view.truth_index is not None
        return frames.image(view.truth_index, background.cpu())

    return image


if __name__ == "__main__":
    run_app(main, "render")
