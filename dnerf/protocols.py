"""Evaluation protocols by name: the choices that make two numbers comparable, and the tables that say them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from dnerf.checks import check_choice

DNERF_SCENES = ("bouncingballs", "hellwarrior", "hook", "jumpingjacks", "lego", "mutant", "standup", "trex")
"""The eight synthetic scenes of D-NeRF, by the names of their folders."""

LEGO = "lego"


@dataclass(frozen=True)
class Protocol:
    """How a run is scored.

    Args:
        name: of the protocol.
        resolution: width of the pictures in pixels; truths are averaged over areas down to it.
        background: behind predictions and truths.
        split: that is scored, for all scenes but Lego.
        note: who publishes by it.
    """

    name: str
    resolution: int
    background: str
    split: str = "test"
    note: str = ""


PROTOCOLS = {
    "dnerf": Protocol("dnerf", 400, "white", note="D-NeRF, TiNeuVox, K-Planes, HexPlane: half resolution on white"),
    "gs": Protocol("gs", 800, "black", note="Gaussian-splatting papers: full resolution on black"),
}


def find_protocol(name: str) -> Protocol:
    """The protocol of a name.

    Raises:
        ValueError: for a name not in `PROTOCOLS`.
    """
    check_choice("protocol", name, tuple(PROTOCOLS))
    return PROTOCOLS[name]


COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("method", "method", ""),
    ("scene", "scene", ""),
    ("split", "split", ""),
    ("psnr", "PSNR", ".2f"),
    ("ssim", "SSIM", ".4f"),
    ("lpips", "LPIPS", ".4f"),
    ("num_frames", "frames", "d"),
    ("resolution", "pixels", "d"),
    ("background", "background", ""),
    ("protocol", "protocol", ""),
    ("seed", "seed", "d"),
    ("train_seconds", "train s", ".0f"),
    ("seconds_per_frame", "s / frame", ".3f"),
    ("num_parameters", "parameters", ",d"),
    ("train_hardware", "trained on", ""),
    ("hardware", "scored on", ""),
    ("train_commit", "training commit", ""),
    ("commit", "scoring commit", ""),
)
"""Key, heading and format of a table's columns."""

MEAN_COLUMNS = ("psnr", "ssim", "lpips", "train_seconds", "seconds_per_frame")


def scene_means(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Means over scenes per method: over D-NeRF's eight, over the seven without Lego, or over what is there.

    Runs of one scene that differ in the seed are averaged first. The eight- and seven-scene means are given only when
    all their scenes are; "mean" covers the scenes present if they are neither.

    Args:
        rows: scores, with the keys of `COLUMNS`.

    Returns:
        Rows whose scene is "mean of 8 (lego: test)", "mean of 7 (without lego)" or "mean of 2 (mutant, trex)".
    """
    means = []
    for key in dict.fromkeys((row["method"], row["protocol"]) for row in rows):
        by_scene: dict[str, list[Mapping[str, Any]]] = {}
        for row in rows:
            if (row["method"], row["protocol"]) == key:
                by_scene.setdefault(row["scene"], []).append(row)
        eight, seven = set(DNERF_SCENES), set(DNERF_SCENES) - {LEGO}
        groups: list[tuple[str, list[str]]] = []
        if eight <= by_scene.keys():
            splits = "/".join(sorted({row["split"] for row in by_scene[LEGO]}))
            groups.append((f"mean of 8 (lego: {splits})", sorted(eight)))
        if seven <= by_scene.keys():
            groups.append(("mean of 7 (without lego)", sorted(seven)))
        present = sorted(by_scene)
        if len(present) > 1 and set(present) not in (eight, seven):
            groups.append((f"mean of {len(present)} ({', '.join(present)})", present))
        for title, scenes in groups:
            means.append({"method": key[0], "protocol": key[1], "scene": title, **_means(by_scene, scenes)})
    return means


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
    columns = [column for column in COLUMNS if any(row.get(column[0]) is not None for row in listed)]
    lines = [
        "| " + " | ".join(heading for _, heading, _ in columns) + " |",
        "|" + "|".join(" ---: " if kind else " --- " for _, _, kind in columns) + "|",
    ]
    for row in listed:
        lines.append("| " + " | ".join(_cell(row.get(key), kind) for key, _, kind in columns) + " |")
    return "\n".join(lines) + "\n"


def csv_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The same rows and means as comma-separated values in full precision, headed by their keys."""
    import csv
    import io

    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, [key for key, _, _ in COLUMNS], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows([*rows, *scene_means(rows)])
    return buffer.getvalue()


def _cell(value: Any, kind: str) -> str:
    if value is None:
        return ""
    return (format(value, kind) if kind else str(value)).replace("|", "\\|")
