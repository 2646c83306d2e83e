"""Evaluation protocols by name: the choices that make two numbers comparable, and the tables that say them."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from dnerf.core.checks import check_choice

# The eight synthetic scenes of D-NeRF, by the names of their folders.
DNERF_SCENES = ("bouncingballs", "hellwarrior", "hook", "jumpingjacks", "lego", "mutant", "standup", "trex")
LEGO = "lego"


@dataclass(frozen=True)
class Protocol:
    """How a run is scored."""

    name: str  # of the protocol
    resolution: int  # width of the images in pixels; truths are averaged over areas down to it
    background: str  # behind predictions and truths
    split: str = "test"  # that is scored, for all scenes but Lego
    note: str = ""  # who publishes by it


PROTOCOLS = {
    "dnerf": Protocol("dnerf", 400, "white", note="D-NeRF, TiNeuVox, K-Planes, HexPlane: half resolution on white"),
    "gs": Protocol("gs", 800, "black", note="Gaussian-splatting papers: full resolution on black"),
}


def find_protocol(name: str) -> Protocol:
    """The protocol of a name; ValueError for a name not in `PROTOCOLS`."""
    check_choice("protocol", name, tuple(PROTOCOLS))
    return PROTOCOLS[name]


# Key, heading and format of a table's columns.
COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("method", "method", ""), ("scene", "scene", ""), ("split", "split", ""),
    ("psnr", "PSNR", ".2f"), ("ssim", "SSIM", ".4f"), ("lpips", "LPIPS", ".4f"), ("lpips_backbone", "LPIPS of", ""),
    ("num_frames", "frames", "d"), ("resolution", "pixels", "d"), ("background", "background", ""),
    ("protocol", "protocol", ""), ("seed", "seed", "d"), ("train_seconds", "train s", ".0f"),
    ("seconds_per_frame", "s / frame", ".3f"), ("num_parameters", "parameters", ",d"),
    ("weights_bytes", "weights, bytes", ",d"), ("train_hardware", "trained on", ""), ("hardware", "scored on", ""),
    ("train_commit", "training commit", ""), ("commit", "scoring commit", ""),
)  # fmt: skip

# What scores must have in common to be averaged.
APART = ("method", "protocol", "resolution", "background", "lpips_backbone")
# What a mean says where all that it averages agree.
SHARED = (
    "split", "seed", "num_frames", "num_parameters", "weights_bytes", "train_hardware", "hardware", "train_commit",
    "commit",
)  # fmt: skip

MEAN_COLUMNS = ("psnr", "ssim", "lpips", "train_seconds", "seconds_per_frame")


def scene_means(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Means over scenes per method: over D-NeRF's eight, over the seven without Lego, or over what is there.

    Scores that differ in `APART` are never averaged. Runs of one scene that differ in the seed are averaged first. The
    eight- and seven-scene means are given only when all their scenes are; any other set of at least two is named, for
    example "mean of 2 (lego: val, mutant)". A mean also says what its rows have in common (`SHARED`).
    """
    apart: dict[tuple[Any, ...], dict[str, list[Mapping[str, Any]]]] = {}
    for row in rows:
        key = tuple(row.get(name) for name in APART)
        apart.setdefault(key, {}).setdefault(row["scene"], []).append(row)
    means = []
    for key, by_scene in apart.items():
        eight, seven = set(DNERF_SCENES), set(DNERF_SCENES) - {LEGO}
        lego = f"{LEGO}: {'/'.join(sorted({row['split'] for row in by_scene.get(LEGO, ())}))}"
        groups: list[tuple[str, list[str]]] = []
        if eight <= by_scene.keys():
            groups.append((f"mean of 8 ({lego})", sorted(eight)))
        if seven <= by_scene.keys():
            groups.append(("mean of 7 (without lego)", sorted(seven)))
        present = sorted(by_scene)
        if len(present) > 1 and set(present) not in (eight, seven):
            named = ", ".join(lego if scene == LEGO else scene for scene in present)
            groups.append((f"mean of {len(present)} ({named})", present))
        for title, scenes in groups:
            shared = {name: value for name, value in zip(APART, key) if value is not None}
            means.append({**shared, "scene": title, **_shared(by_scene, scenes), **_means(by_scene, scenes)})
    return means


def _shared(by_scene: Mapping[str, Sequence[Mapping[str, Any]]], scenes: Sequence[str]) -> dict[str, Any]:
    listed = [row for scene in scenes for row in by_scene[scene]]
    values = {name: {row.get(name) for row in listed} for name in SHARED}
    return {name: found.pop() for name, found in values.items() if len(found) == 1 and None not in found}


def _means(by_scene: Mapping[str, Sequence[Mapping[str, Any]]], scenes: Sequence[str]) -> dict[str, float]:
    means = {}
    for column in MEAN_COLUMNS:
        values = [[row.get(column) for row in by_scene[scene]] for scene in scenes]
        if all(value is not None for of_scene in values for value in of_scene):
            means[column] = fmean(fmean(of_scene) for of_scene in values)  # type: ignore[arg-type]
    return means


def missing_scenes(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The scenes of D-NeRF's eight that no row scores."""
    return [scene for scene in DNERF_SCENES if scene not in {row["scene"] for row in rows}]


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """A Markdown table of rows and their means; columns that no row fills are left out."""
    listed = [*rows, *scene_means(rows)]
    columns = filled_columns(listed)
    lines = [
        "| " + " | ".join(heading for _, heading, _ in columns) + " |",
        "|" + "|".join(" ---: " if kind else " --- " for _, _, kind in columns) + "|",
    ]
    for row in listed:
        cells = [cell(row.get(key), kind).replace("|", "\\|") for key, _, kind in columns]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def table_json(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The same rows and means as plain values, and the scenes of D-NeRF's eight that are not among them."""
    return {"rows": [dict(row) for row in rows], "means": scene_means(rows), "missing": missing_scenes(rows)}


def table_notes(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What a reader of the table has to know: what its protocols mean, and why a mean is not there."""
    notes = []
    for name in dict.fromkeys(row["protocol"] for row in rows):
        if name in PROTOCOLS:
            known = PROTOCOLS[name]
            notes.append(f"Protocol {name}: {known.resolution} pixels wide, on {known.background} ({known.note}).")
        else:
            notes.append(f"Protocol {name}: each run's own images and background; not for comparison with papers.")
    parts = [
        f"{row['scene']} {row['num_frames']} of {row['frames_of_split']}"
        for row in rows
        if row.get("num_frames", 0) < row.get("frames_of_split", 0)
    ]
    if parts:
        notes.append(f"Not all frames were scored, so these rows are not by the protocol: {', '.join(parts)}.")
    missing = missing_scenes(rows)
    if 0 < len(missing) < len(DNERF_SCENES):
        notes.append(f"No mean over eight scenes: {', '.join(missing)} not scored.")
    return notes


def csv_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The same rows and means as comma-separated values in full precision, headed by their keys."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, [key for key, _, _ in COLUMNS], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows([*rows, *scene_means(rows)])
    return buffer.getvalue()


def filled_columns(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Those of `COLUMNS` that some row fills."""
    return [column for column in COLUMNS if any(row.get(column[0]) is not None for row in rows)]


def cell(value: Any, form: str) -> str:
    """A value of a table as text; nothing for None."""
    return "" if value is None else format(value, form) if form else str(value)
