"""Writing what a suite found: report.md for people, CSV and JSON for programs, PNG plots."""

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.plotting import draw
from benchmarks.suite import Row, SuiteResult, Table
from dnerf.core.files import write_json, write_text


def write_report(result: SuiteResult, folder: Path, *, command: str, machine: Mapping[str, Any], date: str) -> Path:
    """Write `report.md`, `results.json`, one CSV per table and one PNG per plot into a folder.

    Args:
        result: what a suite returned.
        folder: made if it is not there; files of the same names are replaced.
        command: the line that made the report.
        machine: hardware, versions and commit, see `describe_machine`.
        date: when it was made.

    Returns:
        The path of `report.md`.

    Raises:
        ValueError: for values that are not plain, or (with plots) without the extra "benchmark".
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for plot in result.plots:
        draw(plot, folder / f"{plot.name}.png")
    for table in result.tables:
        write_text(folder / f"{table_name(table)}.csv", as_csv(table.rows))
    values = {
        "title": result.title, "command": command, "date": date, "machine": dict(machine),
        "findings": list(result.findings),
        "tables": {table_name(t): [_plain(row) for row in t.rows] for t in result.tables},
    }  # fmt: skip
    write_json(folder / "results.json", values)
    write_text(folder / "report.md", as_markdown(result, command=command, machine=machine, date=date))
    return folder / "report.md"


def as_markdown(result: SuiteResult, *, command: str, machine: Mapping[str, Any], date: str) -> str:
    """The report's text."""
    lines = [f"# {result.title}", "", result.summary, "", "```sh", command, "```", ""]
    lines += [f"{date}; " + ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in machine.items()) + ".", ""]
    if result.findings:
        lines += ["## Findings", "", *(f"- {finding}" for finding in result.findings), ""]
    for plot in result.plots:
        lines += [f"## {plot.title}", "", f"![{plot.title}]({plot.name}.png)", ""]
        lines += [plot.note, ""] if plot.note else []
    for table in result.tables:
        lines += [f"## {table.title}", ""]
        lines += [table.note, ""] if table.note else []
        lines += [*markdown_table(table.rows), "", f"[CSV]({table_name(table)}.csv)", ""]
    return "\n".join(lines)


def table_name(table: Table) -> str:
    """File name of a table, without suffix."""
    return table.name or re.sub(r"[^a-z0-9]+", "_", table.title.lower()).strip("_")


def columns(rows: Sequence[Row]) -> list[str]:
    """All keys of the rows, in the order in which they first come."""
    return list(dict.fromkeys(key for row in rows for key in row))


def as_csv(rows: Sequence[Row]) -> str:
    """Rows as CSV with a header, numbers in full."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns(rows), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def show(value: object) -> str:
    """A value as people read it: numbers with three or four digits, None as a dash."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, float):
        return str(value).replace("|", r"\|")
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if not 1e-3 <= abs(value) < 1e6:
        return f"{value:.2e}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.{3 + (abs(value) >= 10)}g}"


def markdown_table(rows: Sequence[Row]) -> list[str]:
    """Lines of a table in Markdown."""
    names = columns(rows)
    numeric = [all(isinstance(row.get(n), (int, float, type(None))) for row in rows) for n in names]
    head = [n.replace("_", " ") for n in names]
    marks = ["---:" if right else "---" for right in numeric]
    body = [[show(row.get(n)) for n in names] for row in rows]
    return ["| " + " | ".join(cells) + " |" for cells in (head, marks, *body)]


def _plain(row: Row) -> dict[str, Any]:
    """JSON knows no infinity and no NaN: they are written as text."""
    return {k: str(v) if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
