"""The page of results says what reports say, and how they were made."""

import json

import pytest

from benchmarks import SuiteResult, Table, write_report
from benchmarks.results import plot_of_all, results_page

pytest.importorskip("matplotlib")

QUALITY = {
    "scene": "mutant", "split": "test", "resolution": 400, "experiment": "fast", "budget_s": 60, "seeds": 3,
    "psnr": 34.756, "psnr_low": 34.5, "psnr_high": 35.0, "ssim": 0.98486, "frames": 20, "steps": 1220, "step_ms": 49.2,
    "frame_s": 0.0267, "model_MiB": 14.25, "peak_MiB": 1370.5, "parameters": 7,
}  # fmt: skip
FRAME = {
    "run": "mutant", "size": "400 x 400", "way": "as trained", "psnr": 36.094, "to_own": None, "median_ms": 22.4,
    "low_ms": 22.3, "high_ms": 22.8, "frames_per_second": 44.6, "model_MiB": 14.25,
}  # fmt: skip
KERNEL = {
    "kernel": "march", "direction": "forward", "samples": 900, "threads": 2, "variant": "compiled", "median_ms": 2.5,
    "times_compiled": 1.0, "times_limit": 51.5,
}  # fmt: skip


def write(folder, name, table, rows, date="2026-11-28 10:00 UTC", hardware="2 x CPU"):
    result = SuiteResult(f"The {name}", "", [Table("Rows", rows, name=table)])
    machine = {"hardware": hardware, "commit": "abc"}
    write_report(result, folder / name, command=f"make {name}", machine=machine, date=f"{date}, in 9 s")


@pytest.fixture
def reports(tmp_path):
    folder = tmp_path / "reports"
    write(folder, "quality", "means_over_seeds", [QUALITY, {**QUALITY, "seeds": 1, "psnr": 30.0}])
    write(folder, "frames", "frames", [FRAME, {**FRAME, "way": "whole intervals", "median_ms": 99.5}])
    slower = {**KERNEL, "variant": "reference", "median_ms": 20.0, "times_compiled": 8.0}
    write(folder, "kernels", "times", [{**KERNEL, "samples": 10, "median_ms": 0.125}, KERNEL, slower])
    write(folder, "other", "rows", [{"value": 1}])
    return folder


def test_page_has_a_row_of_each_result_and_the_command_of_each_report(reports):
    page = results_page(reports)
    link = "[quality](reports/quality/report.md)"
    ends = "0.985 | 1220 | 0.0267 | 14.25 | 2 x CPU | abc |"
    assert f"| {link} | mutant | test | fast | 400 | 60 | 3 | 34.76 [34.50, 35.00] | {ends}" in page
    assert "| 1 | 30.00 |" in page
    assert "| mutant | 400 x 400 | 36.09 | 22.4 | 22.3 | 22.8 | 44.6 | 14.25 |" in page
    assert "99.5" not in page  # another way than the run's own
    assert "| march | forward | 900 | 2.5 | 51.5 | 8 | – |" in page
    assert "0.125" not in page  # of fewer samples
    assert "[other](reports/other/report.md) | The other |" in page
    for name in ("quality", "frames", "kernels", "other"):
        assert f"# {name}: 2026-11-28, commit abc\nmake {name}\n" in page


def test_one_plot_has_what_has_several_budgets_and_stands_above_the_table(reports):
    assert plot_of_all(reports) is None
    later = [{**QUALITY, **x} for x in ({"psnr": 35.0}, {"budget_s": 300, "psnr": 37.0}, {"resolution": 96})]
    write(reports, "a_later_one", "means_over_seeds", later, date="2026-11-29 10:00 UTC")
    write(reports, "gpu", "means_over_seeds", [{**x, "psnr": 5.0} for x in later], "2026-11-30 10:00 UTC", "NVIDIA")
    write(reports, "before", "means_over_seeds", [{**QUALITY, "budget_s": 9}], hardware="1 x CPU")
    (series,) = plot_of_all(reports).series
    assert (series.label, series.x, series.y) == ("mutant, fast", [60, 300], [35.0, 37.0])
    assert "quality.png" not in results_page(reports)
    (reports.parent / "images").mkdir()
    (reports.parent / "images" / "quality.png").touch()
    assert "![PSNR against seconds](images/quality.png)\n\n| report |" in results_page(reports)


def test_a_film_with_a_report_s_name_is_shown_and_no_other(reports):
    assert "## Films" not in results_page(reports)
    films = reports.parent / "images" / "films"
    films.mkdir(parents=True)
    for name in ("frames", "holiday"):
        (films / f"{name}.gif").touch()
    page = results_page(reports)
    assert "## Films" in page
    assert "![frames](images/films/frames.gif)" in page
    assert "holiday" not in page


def test_a_note_and_what_older_reports_lack_are_marked(reports):
    path = reports / "quality" / "results.json"
    values = json.loads(path.read_text())
    values["note"] = "older code"
    row = values["tables"]["means_over_seeds"][0]
    del row["model_MiB"], row["resolution"]
    path.write_text(json.dumps(values))
    page = results_page(reports)
    assert "| mutant | test | fast | – | 60 |" in page
    assert "| – | 2 x CPU | abc † |" in page
    assert "commit abc †: older code\n" in page


def test_a_folder_without_reports_and_a_broken_one_are_named(reports, tmp_path):
    with pytest.raises(ValueError, match="reports must be a folder with"):
        results_page(tmp_path)
    (reports / "other" / "results.json").write_text("{}")
    with pytest.raises(ValueError, match=r"other/results\.json: expected a report"):
        results_page(reports)
