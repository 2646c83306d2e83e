"""Films from the first frame to the finished files: rendered frame by frame, resumed, put together."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from dnerf.core.checks import check_choice
from dnerf.core.files import write_json
from dnerf.data.normalization import IDENTITY, Clock
from dnerf.data.scene_record import World
from dnerf.rendering.renderer import Renderer
from dnerf.visualization.colours import flow_image, scaled_image, value_range
from dnerf.visualization.frame_outputs import Truth, check_outputs, render_layers
from dnerf.visualization.frame_store import FrameStore, write_npz
from dnerf.visualization.video import comparison_sheet, write_frames
from dnerf.visualization.views import View

FILM_FORMATS = ("mp4", "gif", "png", "npz")
SCALE_LABELS = {"depth": "depth", "deformation": "offset"}
MIN_VISIBLE = 1 / 255  # Opacity below which an image in 8 bits shows nothing


def render_frames_to(
    store: FrameStore, renderer: Renderer, views: Sequence[View], outputs: Sequence[str], *, truth: Truth | None = None,
    chunk: int = 16384, on_frame: Callable[[int], None] | None = None, unit: float = 1.0,
) -> int:  # fmt: skip
    """Render the frames that the store lacks, each written while the next one is rendered; returns how many.

    Args:
        store: where frames go; those it holds are left alone.
        views: the film's, as many as the store's frames; ValueError otherwise.
        on_frame: called with the index of every frame written.
        unit: world units in one of those that lengths are written in, see `render_layers`.
    """
    check_outputs(outputs)
    if len(views) != store.num_frames:
        raise ValueError(f"views must be {store.num_frames} as the store's frames, got {len(views)}")
    missing = store.missing()
    in_hand: list[tuple[int, Future[None]]] = []  # one at most

    def finish() -> None:
        while in_hand:
            index, writing = in_hand.pop()
            writing.result()
            if on_frame is not None:
                on_frame(index)

    # Most of the time that a file takes is waiting for the disk.
    with ThreadPoolExecutor(1) as writer:
        try:
            for index in missing:
                following = views[index + 1] if index + 1 < len(views) else None
                layers = render_layers(renderer, views[index], following, outputs, truth=truth, chunk=chunk, unit=unit)
                finish()
                in_hand.append((index, writer.submit(store.write, index, layers)))
        finally:
            finish()
    return len(missing)


def write_films(
    store: FrameStore, path: Path, outputs: Sequence[str], formats: Sequence[str], *, fps: float = 30.0,
    views: Sequence[View] = (), world: World | None = None,
) -> list[Path]:  # fmt: skip
    """Make the finished files of a complete store; returns their paths.

    The output "rgb" (or the only one) gets the path itself with the format's suffix, others `<path>_<output>`; raw
    arrays of all outputs go into one `<path>.npz` with the layers (F, ...), times (F,) in [0, 1], data_times (F,) by
    the data set's own clock, poses (F, 4, 4) in its own units, intrinsics (F, 6: width, height, focal_x, focal_y,
    center_x, center_y in pixels) and pixel_origin (F, text: "center" or "corner", the point of a pixel that its ray
    passes).
    Depth is the distance along the ray, not the z-depth.

    Depth and deformation share one scale over all frames, of which 0.5 % of a frame's opaque pixels lie outside at
    either end; the motion wheel's length is that of the 99.5 % quantile.

    Args:
        formats: some of mp4, gif, png, npz.
        views: the film's, for the NPZ file.
        world: where the data set stands, for its own units and clock in the NPZ file; None if they are the world's.
    """
    check_outputs(outputs)
    for format in formats:
        check_choice("format", format, FILM_FORMATS)
    written = []
    for format in formats:
        if format == "npz":
            written.append(write_npz(store, path.with_name(f"{path.name}.npz"), _facts(views, fps, world)))
            continue
        for output in outputs:
            name = path.name if output == "rgb" or len(outputs) == 1 else f"{path.name}_{output}"
            target = path.with_name(name if format == "png" else f"{name}.{format}")
            written.append(write_frames(_images(store, output), target, format, fps=fps))
    return written


def empty_frames(store: FrameStore) -> list[int]:
    """Indices of a complete store's frames that show nothing: the camera looks elsewhere, or nothing is there then."""
    return [index for index, frame in enumerate(store) if not float(frame["max_opacity"]) >= MIN_VISIBLE]


def write_plan(store: FrameStore, views: Sequence[View], facts: dict[str, object]) -> None:
    """Write the views and facts of a film beside its frames, for people."""
    write_json(store.folder / "plan.json", {**facts, "views": [view.as_dict() for view in views]})


def _images(store: FrameStore, output: str) -> Iterator[NDArray | torch.Tensor]:
    if output == "rgb":
        yield from (frame["rgb"] for frame in store)
    elif output == "opacity":
        yield from (np.repeat(frame["opacity"].clip(0, 1)[..., None], 3, axis=-1) for frame in store)
    elif output == "normals":
        for frame in store:
            share = frame["opacity"].clip(0, 1)[..., None]
            yield share * 0.5 * (frame["normals"] + 1) + (1 - share)
    elif output == "compare":
        for frame in store:
            prediction, truth = (torch.from_numpy(frame[name]).float() / 255 for name in ("rgb", "truth"))
            yield comparison_sheet([(prediction, truth)])
    elif output == "motion":
        lengths = (torch.from_numpy(frame["motion"]).norm(dim=-1) for frame in store)
        longest = _scale((length, length.isfinite()) for length in lengths)[1]
        yield from (flow_image(torch.from_numpy(frame["motion"]), longest) for frame in store)
    else:
        measured = ((torch.from_numpy(frame[output]), torch.from_numpy(frame["opacity"]) >= 0.5) for frame in store)
        low, high = _scale(measured, from_zero=output == "deformation")
        for frame in store:
            values, opacity = torch.from_numpy(frame[output]), torch.from_numpy(frame["opacity"])
            yield scaled_image(values, opacity, low, high, label=SCALE_LABELS[output])


def _scale(measured: Iterable[tuple[torch.Tensor, torch.Tensor]], *, from_zero: bool = True) -> tuple[float, float]:
    """One range of all frames' values where their masks count them, never empty."""
    ranges = [value_range(values, mask) for values, mask in measured if bool(mask.any())]
    low = 0.0 if from_zero else min((low for low, _ in ranges), default=0.0)
    high = max((high for _, high in ranges), default=low)
    return (low, high) if high > low else (low, low + 1.0)


def _facts(views: Sequence[View], fps: float, world: World | None) -> dict[str, NDArray]:
    facts: dict[str, NDArray] = {"fps": np.asarray(fps)}
    if views:
        similarity, clock = (IDENTITY, Clock()) if world is None else (world.similarity, world.clock)
        facts["times"] = np.array([view.time for view in views])
        facts["data_times"] = np.array([clock.own(view.time) for view in views])
        poses = torch.stack([view.camera.pose.cpu() for view in views])
        facts["poses"] = (poses if similarity == IDENTITY else similarity.poses_from_world(poses)).numpy()
        lenses = [view.camera.intrinsics for view in views]
        rows = [(lens.width, lens.height, lens.focal_x, lens.focal_y, *lens.center) for lens in lenses]
        facts["intrinsics"] = np.array(rows)
        facts["pixel_origin"] = np.array([lens.pixel_origin for lens in lenses])
    return facts
