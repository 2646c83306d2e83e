"""Reports: what is written is what was found."""

import csv
import json

import pytest

from benchmarks.report import show, table_name, write_report
from benchmarks.suite import BarPlot, Plot, Series, SuiteResult, Table

pytest.importorskip("matplotlib")


def result(**changes):
    rows = [
        {"rule": "left edge", "samples": 8, "error": 0.125},
        {"rule": "a|b", "samples": 16, "error": float("inf"), "note": None},
    ]
    plot = Plot(
        "errors", "Errors", "samples", "error", [Series("left", [8, 16], [0.1, 0.05], [0.09, 0.04], [0.2, 0.1])]
    )
    values = {
        "title": "T", "summary": "S", "tables": [Table("Two rows!", rows, "N")], "plots": [plot], "findings": ["F"],
    }  # fmt: skip
    return SuiteResult(**{**values, **changes})


def write(folder, found):
    return write_report(found, folder, command="python x.py", machine={"processor": "abc"}, date="2026-01-01")


def test_report_holds_everything(tmp_path):
    path = write(tmp_path / "new" / "folder", result())
    text = path.read_text()
    for part in ("# T", "S", "python x.py", "processor abc", "2026-01-01", "- F", "![Errors](errors.png)", "N"):
        assert part in text
    assert "| left edge | 8 | 0.125 | – |" in text
    assert r"| a\|b | 16 | inf | – |" in text
    values = json.loads((path.parent / "results.json").read_text())
    assert values["tables"]["two_rows"][0] == {"rule": "left edge", "samples": 8, "error": 0.125}
    assert values["machine"] == {"processor": "abc"}
    with (path.parent / "two_rows.csv").open() as file:
        assert list(csv.DictReader(file))[1] == {"rule": "a|b", "samples": "16", "error": "inf", "note": ""}
    assert (path.parent / "errors.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("value", "text"), [
    (None, "–"), (True, "yes"), (3, "3"), (0.0, "0"), (1234.5, "1,234"), (12.345, "12.35"), (1.0, "1"),
    (0.0123456, "0.0123"), (1.5e-7, "1.50e-07"), (float("nan"), "nan"), ("x", "x"),
])  # fmt: skip
def test_numbers_are_shown_with_three_or_four_digits(value, text):
    assert show(value) == text


def test_plot_skips_what_is_not_finite_and_refuses_nonsense(tmp_path):
    series = [
        Series("some", [1, 2, 4], [1.0, float("nan"), 0.25], notes=["a", "", "c"], style="points"),
        Series("guide", [1, 4], [1.0, 0.0625], style="guide"),
        Series("none", [1.0], [float("inf")]),
        Series("dashed", [1, 4], [1.0, 2.0], x_low=[0.5, 3], x_high=[2, 5], style="dashed", color=0),
    ]
    write(tmp_path, result(plots=[Plot("p", "P", "x", "y", series)]))
    assert (tmp_path / "p.png").is_file()
    with pytest.raises(ValueError, match="style must be one of"):
        write(tmp_path, result(plots=[Plot("p", "P", "x", "y", [Series("s", [1], [1], style="dots")])]))
    with pytest.raises(ValueError, match="series of plot 'p' must hold at least one"):
        write(tmp_path, result(plots=[Plot("p", "P", "x", "y", [])]))


def test_tables_are_named_after_their_titles():
    assert table_name(Table("Cost of a step, one core", [])) == "cost_of_a_step_one_core"
    assert table_name(Table("T", [], name="own")) == "own"


def test_bars_are_drawn_on_both_kinds_of_axis(tmp_path):
    for log in (False, True):
        write(tmp_path, result(plots=[BarPlot("b", "B", "ms", ["one", "two"], {"now": [1.0, 2.0]}, log=log)]))
        assert (tmp_path / "b.png").is_file()
