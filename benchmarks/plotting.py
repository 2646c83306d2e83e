"""Plots that read without the text: units on the axes, a label for every line."""

import math
import textwrap
from pathlib import Path
from typing import Any

from benchmarks.suite import BarPlot, Plot, Series
from dnerf.core.checks import check_choice
from dnerf.core.files import atomic_path

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5195", "#4D4D4D", "#8C6D31", "#B22222")
"""Okabe and Ito's colours, which the colour-blind tell apart, and four more."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
STYLES = ("line", "dashed", "points", "guide")


def draw(plot: Plot | BarPlot, path: Path) -> None:
    """Write a plot as PNG.

    Raises:
        ValueError: without matplotlib, without a series, or for an unknown style.
    """
    pyplot = _pyplot()
    height = 5.0
    if isinstance(plot, BarPlot):
        height = max(height, 1.2 + 0.24 * len(plot.categories) * max(len(plot.values), 2))
    figure, axes = pyplot.subplots(figsize=(8.4, height), dpi=120, layout="constrained")
    try:
        # Of the figure rather than of the axes, which long labels may leave little width.
        figure.suptitle(plot.title, x=0.01, horizontalalignment="left", fontsize=12, fontweight="bold")
        axes.set_xlabel(plot.x_label)
        axes.spines[["top", "right"]].set_visible(False)
        if isinstance(plot, BarPlot):
            _draw_bars(figure, axes, plot)
        else:
            _draw_lines(figure, axes, plot)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png")
    finally:
        pyplot.close(figure)


def _draw_lines(figure: Any, axes: Any, plot: Plot) -> None:
    if not plot.series:
        raise ValueError(f"series of plot {plot.name!r} must hold at least one, got none")
    for index, series in enumerate(plot.series):
        _draw_series(axes, series, index)
    axes.set_ylabel(plot.y_label)
    if plot.x_log:
        axes.set_xscale("log")
        _plain_ticks(axes.xaxis, *axes.get_xlim())
    if plot.y_log:
        axes.set_yscale("log")
        _plain_ticks(axes.yaxis, *axes.get_ylim())
    axes.grid(True, which="major", color="#DDDDDD", linewidth=0.8)
    figure.legend(frameon=False, loc="outside right upper", fontsize=10)


def _draw_bars(figure: Any, axes: Any, plot: BarPlot) -> None:
    count = len(plot.values)
    height = 0.8 / count
    for index, (label, lengths) in enumerate(plot.values.items()):
        places = [k - 0.4 + (index + 0.5) * height for k in range(len(plot.categories))]
        bars = axes.barh(places, lengths, 0.92 * height, color=COLORS[index % len(COLORS)], label=label)
        texts = [f" {_short(length)}" if math.isfinite(length) else "" for length in lengths]
        axes.bar_label(bars, texts, fontsize=8)
    axes.set_yticks(range(len(plot.categories)), [textwrap.fill(text, 42) for text in plot.categories])
    axes.invert_yaxis()
    if plot.log:
        axes.set_xscale("log")
    axes.margins(x=0.12)
    figure.legend(frameon=False, loc="outside lower center", ncols=count, fontsize=10)


def _short(value: float) -> str:
    """A number beside a bar: two digits, no powers of ten for those of everyday size."""
    return f"{value:,.0f}" if 100 <= abs(value) < 1e6 else f"{value:.2g}"


def _pyplot() -> Any:
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError as error:
        raise ValueError("plots need the extra: pip install 'dnerf[benchmark]'") from error
    return pyplot


def _draw_series(axes: Any, series: Series, index: int) -> None:
    check_choice("style", series.style, STYLES)
    points = [(x, y, k) for k, (x, y) in enumerate(zip(series.x, series.y)) if math.isfinite(x) and math.isfinite(y)]
    if not points:
        return
    xs, ys, kept = zip(*points)
    index = index if series.color is None else series.color
    color = "#999999" if series.style == "guide" else COLORS[index % len(COLORS)]
    if series.style == "guide":
        axes.plot(xs, ys, color=color, linestyle="--", linewidth=1.0, zorder=1, label=series.label)
    else:
        line = {"line": "-", "dashed": (0, (4, 2)), "points": "none"}[series.style]
        marker = MARKERS[index % len(MARKERS)]
        style = {"linestyle": line, "linewidth": 1.8, "marker": marker, "markersize": 5.5}
        axes.plot(xs, ys, color=color, zorder=3, label=series.label, **style)
    if series.low is not None and series.high is not None:
        low, high = ([values[k] for k in kept] for values in (series.low, series.high))
        if series.style in ("line", "dashed") and len(xs) > 1:
            axes.fill_between(xs, low, high, color=color, alpha=0.15, linewidth=0, zorder=2)
        else:
            axes.vlines(xs, low, high, color=color, alpha=0.6, linewidth=1.5, zorder=2)
    if series.x_low is not None and series.x_high is not None:
        low, high = ([values[k] for k in kept] for values in (series.x_low, series.x_high))
        axes.hlines(ys, low, high, color=color, alpha=0.35, linewidth=3.5, zorder=2)
    for x, y, k in zip(xs, ys, kept):
        if series.notes is not None and series.notes[k]:
            axes.annotate(
                series.notes[k], (x, y), xytext=(4, 5), textcoords="offset points", fontsize=8, color=color
            )  # fmt: skip


def _plain_ticks(axis: Any, low: float, high: float) -> None:
    """Numbers such as 0.5, 2 and 50 on a log axis of a few decades rather than powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    decades = math.log10(max(high, 1e-300)) - math.log10(max(low, 1e-300))
    if low <= 0 or decades > 4 or low < 1e-4 or high > 1e6:
        return
    axis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5) if decades < 2.2 else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axis.set_minor_formatter(NullFormatter())
