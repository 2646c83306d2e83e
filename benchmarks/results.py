"""One page of all results, from the reports that suites have written."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.kernel_cases import COMPILED, PLAIN, REFERENCE
from benchmarks.report import markdown_table
from benchmarks.suite import Plot, Row
from benchmarks.training import quality_plot

HEAD = """# Results

This page is a reference. `python scripts/results.py` makes it from the reports in {folder}; edit neither.
Below each table stand the commands that made its reports, with date and commit.
Compare times within one report only: machines, and hours of one machine, differ.
A dash is what a report does not say; a dagger after a commit points to a note beside the command.
"""

QUALITY = "means_over_seeds"  # table of suite=training
PLOT = "images/quality.png"
FILMS = "images/films"  # beside the reports' folder: a film has its report's name
FILMS_NOTE = """Each is of a run of the report of that name, by
`python scripts/render.py run=... path=orbit num_frames=40 fps=10 resolution=180 format=gif`.
"""


def results_page(folder: Path) -> str:
    """The page's text, in Markdown.

    Args:
        folder: of the reports, one folder with a `results.json` for each; links to them are relative to its parent,
            where films of some may lie.

    Raises:
        ValueError: for a folder without reports, or naming a file that is none.
    """
    reports = _reports(folder)
    parts = [HEAD.format(folder=f"[{folder.name}/]({folder.name}/)")]
    films = [name for name in reports if (folder.parent / FILMS / f"{name}.gif").is_file()]
    if films:
        parts += ["## Films\n", FILMS_NOTE, *(f"![{name}]({FILMS}/{name}.gif)" for name in films), ""]
    left = dict(reports)
    for title, table, note, rows_of in SECTIONS:
        own = {name: report for name, report in reports.items() if table in report["tables"]}
        rows = [
            {"report": _link(folder, name), **row, "hardware": report["machine"]["hardware"], "commit": _commit(report)}
            for name, report in own.items()
            for row in rows_of(report["tables"][table])
        ]
        if rows:
            shown = [f"![PSNR against seconds]({PLOT})\n"] * (table == QUALITY and (folder.parent / PLOT).is_file())
            parts += [f"## {title}\n", note + "\n", *shown, *markdown_table(rows), "", _commands(own)]
        left = {name: report for name, report in left.items() if name not in own}
    if left:
        rows = [{"report": _link(folder, name), "what": report["title"]} for name, report in left.items()]
        parts += ["## Other reports\n", *markdown_table(rows), "", _commands(left)]
    return "\n".join(parts)


def plot_of_all(folder: Path) -> Plot | None:
    """PSNR against seconds of training at 400 x 400, all on one CPU: that of the latest report.

    Of two reports of the same, the later one counts. None if nothing has several budgets; ValueError as `results_page`.
    """
    rows: dict[str, dict[tuple[Any, ...], dict[str, Any]]] = {}
    for report in sorted(_reports(folder).values(), key=lambda report: report["date"]):
        hardware, table = report["machine"]["hardware"], report["tables"].get(QUALITY, [])
        own = {(row["scene"], row["experiment"], row["budget_s"]): row for row in table if row.get("resolution") == 400}
        if own and "NVIDIA" not in hardware:
            rows[hardware] = {**rows.pop(hardware, {}), **own}  # the last one of all
    latest = next(reversed(rows.values()), {})
    counts = Counter(key[:2] for key in latest)
    shown = [latest[key] for key in sorted(latest) if counts[key[:2]] > 1]
    return quality_plot(shown) if shown else None


def _reports(folder: Path) -> dict[str, dict[str, Any]]:
    reports = {path.parent.name: _read(path) for path in sorted(folder.glob("*/results.json"))}
    if not reports:
        raise ValueError(f"reports must be a folder with */results.json, found none in {folder}")
    return reports


def _read(path: Path) -> dict[str, Any]:
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not a readable JSON file ({error})") from error
    if not isinstance(report, dict) or not {"title", "command", "date", "machine", "tables"} <= report.keys():
        raise ValueError(f"{path}: expected a report of scripts/benchmark.py")
    return report


def _link(folder: Path, name: str) -> str:
    return f"[{name}]({folder.name}/{name}/report.md)"


def _commit(report: Mapping[str, Any]) -> str:
    return report["machine"]["commit"] + (" †" if "note" in report else "")


def _commands(reports: Mapping[str, Mapping[str, Any]]) -> str:
    lines = []
    for name, report in reports.items():
        note = f": {report['note']}" if "note" in report else ""
        lines += [f"# {name}: {report['date'][:10]}, commit {_commit(report)}{note}", report["command"]]
    return "\n".join(["```sh", *lines, "```", ""])


def _quality(rows: list[Row]) -> Iterator[Row]:
    for row in rows:
        is_one = row["seeds"] == 1
        yield {
            **{name: row[name] for name in ("scene", "split", "experiment")}, "pixels": row.get("resolution"),
            "seconds": row["budget_s"], "seeds": row["seeds"],
            "PSNR": f"{row['psnr']:.2f}" + ("" if is_one else f" [{row['psnr_low']:.2f}, {row['psnr_high']:.2f}]"),
            "SSIM": f"{row['ssim']:.3f}", "steps": row["steps"], "frame s": row["frame_s"],
            "model MiB": row.get("model_MiB"),
        }  # fmt: skip


def _frames(rows: list[Row]) -> Iterator[Row]:
    """What every run takes with its own settings, which come first."""
    known = set()
    for row in rows:
        if (row["run"], row["size"]) not in known:
            known.add((row["run"], row["size"]))
            yield {
                **{name: row[name] for name in ("run", "size")},
                "PSNR": None if row["psnr"] is None else f"{row['psnr']:.2f}",
                **{name: row[name] for name in ("median_ms", "low_ms", "high_ms", "frames_per_second")},
                "model MiB": row.get("model_MiB"),
            }


def _kernels(rows: list[Row]) -> Iterator[Row]:
    """Every kernel on the most samples and threads."""
    most = max(row["samples"] for row in rows), max(row["threads"] for row in rows)
    chosen = [row for row in rows if (row["samples"], row["threads"]) == most]
    for kernel, direction in dict.fromkeys((row["kernel"], row["direction"]) for row in chosen):
        found = {r["variant"]: r for r in chosen if (r["kernel"], r["direction"]) == (kernel, direction)}
        yield {
            "kernel": kernel, "direction": direction, "samples": most[0], "compiled ms": found[COMPILED]["median_ms"],
            "times its least traffic": found[COMPILED]["times_limit"],
            **{f"{name}, times": found.get(name, {}).get("times_compiled") for name in (REFERENCE, PLAIN)},
        }  # fmt: skip


QUALITY_NOTE = """Held-out frames; with several seeds their mean and, in brackets, worst and best. `model MiB` is the
size of the weights file. D-NeRF's Lego is scored on `val`: its test split shows another pose than its train split.
The plot has the latest report of each row at 400 x 400, of the CPU that was used last. Commits differ, see below."""
FRAMES_NOTE = "Each frame alone, in evaluation mode: median and quartiles of the time."
KERNELS_NOTE = "The compiled version, and how many times as long its definition and the best plain torch take."
SECTIONS: tuple[tuple[str, str, str, Callable[[list[Row]], Iterator[Row]]], ...] = (
    ("Quality after seconds of training", QUALITY, QUALITY_NOTE, _quality),
    ("Frames", "frames", FRAMES_NOTE, _frames),
    ("Kernels", "times", KERNELS_NOTE, _kernels),
)
"""Title, table of the reports, note, and what is taken from that table."""
