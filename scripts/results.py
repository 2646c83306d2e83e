"""One page of all results from the reports: python scripts/results.py [--reports docs/reports] [--output ...]"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # `benchmarks` is no part of the installed package

from benchmarks.plotting import draw
from benchmarks.results import PLOT, plot_of_all, results_page
from dnerf.core.files import write_text

REPORTS = Path(__file__).resolve().parents[1] / "docs" / "reports"


def main() -> None:
    """Read the reports, write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--reports", type=Path, default=REPORTS)
    parser.add_argument("--output", type=Path, help="the page; results.md beside the reports' folder by default")
    given = parser.parse_args()
    output = given.output or given.reports.parent / "results.md"
    plot = plot_of_all(given.reports)
    if plot is not None:
        draw(plot, given.reports.parent / PLOT)
    write_text(output, results_page(given.reports))
    print(f"results: {output}")


if __name__ == "__main__":
    try:
        main()
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
