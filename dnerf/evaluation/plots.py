"""Curves of scores over time, as SVG; needs the extra "report"."""

from collections.abc import Mapping, Sequence
from io import StringIO
from typing import Any

COLORS = ("#1b6f8a", "#c2513d", "#6b5aa8", "#5b8c3a", "#b0792b", "#444444")


def frame_curves(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """The PSNR of every frame over its time, one curve per run, as an SVG document: equal numbers, equal bytes.

    Frames by run each have "time" and "psnr", as in `metrics.json`. Raises ValueError if a frame has none, or the extra
    is not installed.
    """
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ValueError("plots need the extra: pip install 'dnerf[report]'") from error
    for name, frames in runs.items():
        if not frames or any("psnr" not in frame for frame in frames):
            raise ValueError(f"runs: {name} must have frames with psnr")
    # The figure is made without pyplot, which would choose a display; ids are salted so that bytes repeat.
    with mpl.rc_context({"svg.hashsalt": "dnerf", "font.size": 10, "svg.fonttype": "path"}):
        figure = Figure(figsize=(7.2, 2.6), layout="constrained")
        axes = figure.add_subplot()
        for index, (name, frames) in enumerate(runs.items()):
            ordered = sorted(frames, key=lambda frame: frame["time"])
            times, values = [frame["time"] for frame in ordered], [frame["psnr"] for frame in ordered]
            axes.plot(times, values, marker="o", markersize=3, linewidth=1.4, label=name, color=COLORS[index % 6])
        axes.set_xlim(-0.02, 1.02)
        axes.set_xlabel("time")
        axes.set_ylabel("PSNR in dB")
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        if len(runs) > 1:
            axes.legend(frameon=False, fontsize=9)
        buffer = StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    return svg[svg.index("<svg") :]
