"""From a film, images or a COLMAP model to a data set in nerfstudio's format; a run that was killed goes on."""

import math
import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from dnerf.capturing.frames import ChosenFrame, Film, choose_frames
from dnerf.capturing.structure import (
    GOOD_TRACK,
    SLOWLY,
    WALK,
    StructureSettings,
    find_structure,
    keep_good_points,
    load_pycolmap,
)
from dnerf.core.checks import check_whole
from dnerf.core.files import atomic_path, claimed, remove_leftovers, write_json
from dnerf.data.capture import CaptureFrame
from dnerf.data.formats import colmap
from dnerf.data.formats.json_files import read_object
from dnerf.data.formats.writers import transforms_fields

GOOD_SHARE, GOOD_ERROR = 0.95, 1.5  # of frames placed, and mean pixels off: below and above, the report warns
LEAST_FRAMES = 3
POINTS, MANIFEST = "points.ply", "transforms.json"


def capture(
    out_dir: Path, films: Sequence[Film],
    settings: StructureSettings = StructureSettings(),  # noqa: B008 (it is frozen)
    *, model: Path | None = None, num_frames: int = 120, width: int = 960, min_share: float = 0.5,
) -> list[str]:  # fmt: skip
    """Make a data set, and say how good it is: lines of a report, warnings last.

    Each stage leaves its result in `out_dir`, and is not done again. `transforms.json` is written last.

    Args:
        out_dir: a new or empty folder, or that of a capture of the same files.
        films: see `find_films`.
        model: a folder with COLMAP's model of the images, instead of finding their cameras.
        num_frames: of each film, the sharpest of equal stretches; of images in no order, or of a model, all are taken.
        width: of the longer side of the data set's images, at most.
        min_share: of frames that must be placed, in [0, 1].

    Raises:
        ValueError: in one line that says what is wrong, and what to do or to film instead.
    """
    check_whole("num_frames", num_frames)
    if num_frames < LEAST_FRAMES:
        raise ValueError(f"num_frames must be at least {LEAST_FRAMES}, got {num_frames}")
    check_whole("width", width)
    if not 0 <= min_share <= 1:
        raise ValueError(f"min_share must be in [0, 1], got {min_share}")
    if model is not None and not films[0].images:
        raise ValueError("model needs images=folder, that of the images it was made of")
    load_pycolmap()
    files = [_stamps(film.images or (film.path,)) for film in films]
    given = None if model is None else _stamps(path for path in model.rglob("*") if path.is_file())
    stages = _Stages(out_dir, {"num_frames": num_frames, "width": width, "files": files})
    images, work, is_ordered = out_dir / "images", out_dir / "structure", all(film.is_ordered for film in films)
    count = num_frames if is_ordered and model is None else None
    with claimed(out_dir):
        for folder in (out_dir, images, *images.glob("*/")):
            remove_leftovers(folder)
        chosen = stages.result("frames", None, lambda: [vars(f) for f in choose_frames(films, images, count, width)])
        frames = [ChosenFrame(**(fields | {"size": tuple(fields["size"])})) for fields in chosen]
        if len(frames) < LEAST_FRAMES:
            raise ValueError(f"a data set needs {LEAST_FRAMES} frames or more, got {len(frames)}; film longer")
        masks = [] if settings.masks is None else _stamps(p for p in settings.masks.rglob("*") if p.is_file())
        of_features = [settings.lens, masks]
        stages.result("features", of_features, lambda: shutil.rmtree(work, ignore_errors=True))

        def find() -> dict[str, Any]:
            (out_dir / MANIFEST).unlink(missing_ok=True)  # it goes with the points that were
            if model is not None:
                return _keep([_given_model(model, frames)], len(frames), 0.0, out_dir)
            models = find_structure(frames, images, work, settings, is_ordered=is_ordered)
            return _keep(models, len(frames), min_share, out_dir)

        found = stages.result("structure", [of_features, settings.matching, min_share, given], find)
        cameras = colmap.read(out_dir).splits["all"]
        times = {frame.name.removesuffix(".png"): frame.time for frame in frames}
        listed = [
            {"file_path": f"images/{c.name}.png", "time": times[c.name], "transform_matrix": c.pose} for c in cameras
        ]
        lenses, points = [camera.intrinsics for camera in cameras], {"ply_file_path": POINTS}
        write_json(out_dir / MANIFEST, transforms_fields(listed, lenses, points))
    return _report(found, cameras, out_dir)


class _Stages:
    """What has been done in a folder, as its `capture.json` says; ValueError for one that holds something else."""

    def __init__(self, folder: Path, made_from: dict[str, Any]) -> None:
        self.path = folder / "capture.json"
        is_known = self.path.is_file()
        self.done = read_object(self.path) if is_known else {"made_from": made_from}
        if self.done.get("made_from") != made_from or (not is_known and folder.exists() and any(folder.iterdir())):
            raise ValueError(f"out_dir: {folder} holds something else, or of other settings; give another or remove it")
        write_json(self.path, self.done)

    def result(self, stage: str, of: Any, make: Callable[[], Any]) -> Any:
        """What a stage has found, now or in an earlier run in which it was made of the same."""
        if stage not in self.done or self.done[stage]["of"] != of:
            self.done[stage] = {"of": of, "result": make()}
            write_json(self.path, self.done)
        return self.done[stage]["result"]


def _stamps(paths: Iterable[Path]) -> list[list[Any]]:
    """What tells versions of files apart."""
    return sorted([str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns] for path in paths)


def _given_model(folder: Path, frames: Sequence[ChosenFrame]) -> Any:
    """A model of COLMAP's whose images have the names of frames; ValueError if it cannot be read, or fits none."""
    try:
        model = load_pycolmap().Reconstruction(folder)
    except (ValueError, RuntimeError, OSError) as error:
        raise ValueError(f"model: {folder} must hold cameras, images and points3D of COLMAP; {error}") from error
    names = {frame.name.removesuffix(".png"): frame.name for frame in frames}
    for image in model.images.values():
        name = names.get(Path(image.name).with_suffix("").as_posix())
        if name is None:
            raise ValueError(f"model: {folder} has the image {image.name}, which is not in the folder of images")
        image.name = name
    return model


def _keep(models: Sequence[Any], num_frames: int, min_share: float, out_dir: Path) -> dict[str, Any]:
    """Write the first model and its good points beside the images; ValueError if it has too few of the frames."""
    model, parts = models[0], [model.num_reg_images() for model in models]
    found = {"parts": parts, "frames": num_frames, "error": model.compute_mean_reprojection_error()}
    if parts[0] < min_share * num_frames:
        others = f", in pieces of {', '.join(map(str, parts))} that share nothing" if len(parts) > 1 else ""
        raise ValueError(
            f"only {parts[0]} of {num_frames} frames could be placed{others}; {SLOWLY}; {WALK}; or give one piece of "
            f"the film alone, or min_share={parts[0] / num_frames:.2f} to go on with the largest"
        )
    unfinished = out_dir / "sparse" / ".unfinished"
    shutil.rmtree(unfinished.parent, ignore_errors=True)
    unfinished.mkdir(parents=True)
    model.write(unfinished)
    unfinished.rename(unfinished.with_name("0"))
    keep_good_points(model)
    with atomic_path(out_dir / POINTS) as temporary:
        model.export_PLY(temporary)
    return found | {"points": model.num_points3D()}


def _report(found: dict[str, Any], cameras: Sequence[CaptureFrame], folder: Path) -> list[str]:
    placed, total, error = found["parts"][0], found["frames"], found["error"]
    lens = cameras[0].intrinsics
    ratio = max(lens.width / lens.focal_x, lens.height / lens.focal_y)
    is_fisheye = lens.distortion is not None and lens.distortion.model == "fisheye"
    degrees = math.degrees(ratio if is_fisheye else 2 * math.atan(0.5 * ratio))
    lines = [
        f"frames placed: {placed} of {total} ({placed / total:.0%})",
        f"reprojection error: {error:.2f} pixels in images of {lens.width} x {lens.height}",
        f"points: {found['points']}, of which each is seen in {GOOD_TRACK} frames or more",
        f"lens: focal length {lens.focal_x:.0f} pixels, {degrees:.0f} degrees across the longer side",
        f"data set: {folder}",
    ]
    if placed < GOOD_SHARE * total:
        pieces = f" (pieces of {', '.join(map(str, found['parts']))})" if len(found["parts"]) > 1 else ""
        lines.append(f"warning: frames that could not be placed are left out{pieces}; {SLOWLY}")
    if error > GOOD_ERROR:
        lines.append("warning: the error is large: mask what moves (masks=...), or try lens=SIMPLE_RADIAL")
    return lines
