"""One self-contained HTML page about a run: films, images, curves, scores, config; needs the extra "report"."""

import base64
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dnerf.data.videos import read_video_header
from dnerf.evaluation.plots import frame_curves
from dnerf.evaluation.protocols import cell, filled_columns

TEMPLATE = Path(__file__).parent / "templates" / "report.html.jinja"
TYPES = {".mp4": "video/mp4", ".gif": "image/gif", ".png": "image/png"}
MAX_BYTES = 40 * 2**20  # Most bytes of films and images in one page: mail and chat refuse larger ones
# What a film shows, by the end of its file's name.
FILM_NOTES = {
    "depth": "expected distance along the ray (not z-depth), in world units",
    "opacity": "white where light is absorbed, black where it passes",
    "motion": "hue is the direction and saturation the length of the motion to the next frame, in pixels, the camera's "
    "included; white stands still, grey is not known",
    "deformation": "distance between a point and its place in canonical space, in world units",
    "compare": "prediction, truth, absolute error",
}

# Measure, its value for the exact scene and for standing still, what it means, its format.
TEMPORAL = (
    ("film_psnr", None, None, "dB, of the film's frames", ".2f"),
    ("temporal_psnr", None, None, "dB, of frame differences: what is wrong with the change", ".2f"),
    ("warping_error", "true_warping_error", None, "mean squared colour difference along the motion", ".5f"),
    ("flicker", "true_flicker", None, "root mean square second difference in time", ".4f"),
    ("depth_consistency", "true_depth_consistency", None, "relative depth difference along the motion", ".4f"),
    ("flow_error", "true_flow_error", "still_flow_error", "end-point error of motion vectors in pixels", ".3f"),
    ("flow_outliers", None, None, "share of vectors off by more than 3 pixels and 5 %", ".4f"),
    ("scene_flow_error", None, None, "3-D end-point error in world units", ".4f"),
    ("track_error", None, "still_track_error", "3-D error of long tracks in world units", ".4f"),
    ("track_accuracy", None, None, "share of track points within 1, 2, 4, 8, 16 pixels of 256, averaged", ".3f"),
    ("found", None, None, "share of visible pixels whose motion was found", ".3f"),
)
NOT_MEASURED = "not measured"


def write_report_text(
    *, title: str, metrics: Sequence[Mapping[str, Any]], config: str, films: Sequence[Path] = (),
    sheets: Sequence[tuple[str, str, Path]] = (), temporal: Mapping[str, Any] | None = None,
    plan: Sequence[Sequence[str]] = (),
) -> str:  # fmt: skip
    """The page of a run as HTML text.

    Everything is inside: films and images as data URIs, curves as SVG. Nothing is loaded from elsewhere, no script
    runs, and all text is escaped.

    Args:
        metrics: scores as in `metrics.json`, the main ones first; at least one.
        config: the run's config as YAML text.
        sheets: heading, caption and PNG file of each image.
        temporal: scores over time as in `temporal.json`, or None.
        plan: rows of the table of decisions, its header first; none if nothing was decided.

    Raises:
        ValueError: if the extra is not installed, there are no scores, a file is of another type, or all are too large
            to be sent around.
    """
    try:
        from jinja2 import Environment, StrictUndefined
    except ImportError as error:
        raise ValueError("reports need the extra: pip install 'dnerf[report]'") from error
    if not metrics:
        raise ValueError("metrics must hold the scores of at least one evaluation, got none")
    size = sum(path.stat().st_size for path in [*films, *(path for _, _, path in sheets)])
    if size > MAX_BYTES:
        raise ValueError(f"films and images must be at most {MAX_BYTES >> 20} MiB together, got {size / 2**20:.0f}")
    first, listed = metrics[0], [{"protocol": "own", **m} for m in metrics]
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        title=title, lead=_lead(first), cards=_cards(first), protocol_note=_protocol_note(first),
        films=[_film(path) for path in films],
        sheets=[{"title": heading, "caption": caption, "uri": data_uri(path)} for heading, caption, path in sheets],
        curves=[_curve(m) for m in metrics if len(m["frames"]) > 1],
        temporal=None if temporal is None else _temporal(temporal), plan=plan,
        # A row per measure and a column per evaluation: there are many of the one and few of the other.
        table=[(name, [cell(m.get(key), form) for m in listed]) for key, name, form in filled_columns(listed)],
        facts=_facts(first), frames=_frames(first["frames"]), config=config,
    )  # fmt: skip


def data_uri(path: Path) -> str:
    """A file's bytes as a `data:` address; ValueError for a type that the page does not show."""
    if path.suffix.lower() not in TYPES:
        raise ValueError(f"{path}: expected one of {', '.join(TYPES)}")
    return f"data:{TYPES[path.suffix.lower()]};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def read_scores(folder: Path) -> list[dict[str, Any]]:
    """All `metrics*.json` of a run's folder, those of named protocols first.

    Raises ValueError naming the folder or file, if there is none or one is broken.
    """
    found = []
    for path in sorted(Path(folder).glob("metrics*.json"), key=lambda path: (path.name == "metrics.json", path.name)):
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            found.append({**values, "frames": list(values["frames"]), "split": str(values["split"])})
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: not a file of scores ({error})") from error
    if not found:
        raise ValueError(f"{folder}: no metrics.json; score the run first: python scripts/evaluate.py run={folder}")
    return found


def _film(path: Path) -> dict[str, str]:
    kind = "video" if path.suffix.lower() == ".mp4" else "image"
    note = FILM_NOTES.get(path.stem.rpartition("_")[2], "")
    wide = "wide" if kind == "video" and (film := read_video_header(path)).width > 2 * film.height else ""
    return {"uri": data_uri(path), "kind": kind, "caption": path.stem.replace("_", " "), "note": note, "wide": wide}


def _curve(metrics: Mapping[str, Any]) -> dict[str, str]:
    title = f"PSNR over time, {metrics['split']} split, {_protocol(metrics)}"
    return {"title": title, "svg": frame_curves({metrics["split"]: metrics["frames"]})}


def _protocol(metrics: Mapping[str, Any]) -> str:
    name = metrics.get("protocol", "own")
    return "the run's own protocol" if name == "own" else f"protocol {name}"


def _lead(metrics: Mapping[str, Any]) -> str:
    parts = [str(metrics.get("method", "a model")), f"on {metrics['scene']}" if "scene" in metrics else ""]
    if "train_seconds" in metrics:
        parts.append(f"after {metrics['train_seconds']:.0f} seconds of training")
    return " ".join(part for part in parts if part)


def _cards(metrics: Mapping[str, Any]) -> list[dict[str, str]]:
    cards = [
        {"value": f"{metrics['psnr']:.2f} dB", "label": f"PSNR, {metrics['split']}"},
        {"value": f"{metrics['ssim']:.4f}", "label": f"SSIM, {metrics['split']}"},
    ]
    if "lpips" in metrics:
        cards.append({"value": f"{metrics['lpips']:.4f}", "label": f"LPIPS ({metrics.get('lpips_backbone', '?')})"})
    if "train_seconds" in metrics:
        cards.append({"value": f"{metrics['train_seconds']:.0f} s", "label": f"training, {metrics['num_steps']} steps"})
    cards.append({"value": f"{metrics['seconds_per_frame']:.2f} s", "label": "to render a frame"})
    return cards


def _protocol_note(metrics: Mapping[str, Any]) -> str:
    scored, there = metrics["num_frames"], metrics.get("frames_of_split")
    number = scored if there is None else f"{scored} of the {there}" if scored < there else f"all {there}"
    size = f"{metrics['resolution']} pixels wide, " if "resolution" in metrics else ""
    background = f"on {metrics['background']}, " if "background" in metrics else ""
    return (
        f"Means over {number} frames of the {metrics['split']} split, {size}{background}{_protocol(metrics)}. "
        "PSNR is of floats clamped to [0, 1] against 8-bit truths; SSIM has a Gaussian window of 11 pixels."
    )


def _temporal(scores: Mapping[str, Any]) -> dict[str, Any]:
    exact = scores["motion"] == "exact"
    source = (
        "Motion, occlusion, tracks and true frames are the scene's own, exactly. The exact scene has errors of its "
        "own: those of images with finite pixels."
        if exact
        else "The true motion is not known: things are followed by the model's own motion, so this is consistency only."
    )
    rows = []
    for name, floor, still, meaning, form in TEMPORAL:
        if name in scores:
            value, *references = (_temporal_cell(scores, key, form) for key in (name, floor, still))
            row = {"name": name.replace("_", " "), "value": value, "meaning": meaning}
            rows.append(row | dict(zip(("floor", "still"), references)))
    film = f"A film of {scores['num_frames']} frames from t = 0 to 1 at the first camera"
    return {"note": f"{film}, {scores.get('resolution', '?')} pixels wide. {source}", "rows": rows}


def _temporal_cell(scores: Mapping[str, Any], key: str | None, form: str) -> str:
    if key is None or key not in scores:
        return ""
    return NOT_MEASURED if scores[key] is None else format(scores[key], form)


def _facts(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    names = (
        ("seed", "seed", ""), ("num_steps", "training steps", ",d"), ("train_seconds", "training seconds", ".1f"),
        ("num_parameters", "parameters", ",d"), ("weights_bytes", "weights in bytes", ",d"),
        ("train_hardware", "trained on", ""), ("train_commit", "trained at commit", ""),
        ("hardware", "scored on", ""), ("commit", "scored at commit", ""), ("version", "dnerf", ""),
        ("torch", "torch", ""),
    )  # fmt: skip
    return [(label, cell(metrics[key], form)) for key, label, form in names if metrics.get(key) is not None]


def _frames(frames: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    columns = [("index", "frame", "d"), ("time", "time", ".3f"), ("psnr", "PSNR", ".2f"), ("ssim", "SSIM", ".4f")]
    if frames and "lpips" in frames[0]:
        columns.append(("lpips", "LPIPS", ".4f"))
    rows = [[cell(frame.get(key), form) for key, _, form in columns] for frame in frames]
    return {"headings": [label for _, label, _ in columns], "rows": rows}
