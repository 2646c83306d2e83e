"""Samples per ray against error: rules for density, places of samples, and the exact edges of surfaces as the limit."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from benchmarks.smooth import SmoothClouds, exact_smooth
from benchmarks.suite import Plot, Series, Settings, SuiteResult, Table
from benchmarks.timing import fitted_order, time_in_turn
from dnerf.core.compositing import FieldOutput, composite
from dnerf.core.rays import Rays, Samples
from dnerf.data import render_exact
from dnerf.fields.base import RadianceField
from dnerf.samplers import ImportanceSampler, OccupancyGrid, OccupancySampler, StratifiedSampler
from dnerf.scenes import AnalyticScene, make_scene

SMOOTH = "smooth_clouds"
SCENES = (SMOOTH, "pulsing_fog", "orbiting_balls", "thin_rod")
Method = Callable[[RadianceField, Rays, int], Tensor]

THEORY = {
    "constant": 2.0, "left edge": 2.0, "stratified": 1.5, "stratified, linear": 1.5, "linear": 2.0, "parabolic": 4.0,
    "importance": 2.0, "occupancy": 2.0,
}  # fmt: skip
"""Orders of convergence on smooth density that vanishes at both ends of a ray."""
EDGES = 1.0
"""Order at hard edges, where the share of an interval that is full is a matter of chance."""
ROUNDED = 2e-7
"""Errors below this are float32's rounding."""
ORDERS_NOTE = f"Least squares over the last four errors between {ROUNDED:g} (rounding) and 0.05."


def run(settings: Settings) -> SuiteResult:
    """Render rays with every method and number of samples; compare with the exact colours."""
    counts = [8, 32, 128] if settings.quick else [8, 16, 32, 64, 128, 256, 512]
    num_rays = 300 if settings.quick else 1000
    rows, orders, plots, findings = [], [], [], []
    for name in SCENES[: 2 if settings.quick else None]:
        field: RadianceField = SmoothClouds() if name == SMOOTH else make_scene(name)
        rays = _rays(num_rays, settings.seed)
        truth, bound = _truth(field, rays)
        own = []
        for method, call in methods(field, settings.quick).items():
            for count in counts:
                own.append(_row(name, method, count, call, (field, rays, truth), settings))
        if isinstance(field, AnalyticScene):
            own.append(_exact_row(name, field, rays, truth))
        rows += own
        orders += _orders(name, own)
        plots.append(_plot(name, own, bound))
        findings += _findings(name, own, counts)
    return SuiteResult(
        title="Quadrature: samples per ray against error",
        summary=(
            f"{num_rays} rays through each scene, in float32, rendered with the shared compositor; the error is the "
            "root mean square over rays of the colour's largest channel, against the exact colour in float64 (surface "
            f"edges and Gauss rules; for `{SMOOTH}`, Gaussian clouds without edges, a closed-form optical depth and a "
            "Gauss rule whose own error the plot tells). `constant`, `linear` and `parabolic` are rules of the "
            "compositor (`renderer.quadrature`) at the middles of equal intervals; `left edge` evaluates where they "
            "begin; `stratified` at a random point (one realisation); `importance` places half of the "
            "samples by the other half; `occupancy` spends its samples in occupied cells only, counted per ray that "
            "hits some. Theory: on smooth density midpoints and trapezia (`linear`) are of second order, `parabolic` "
            "of fourth, random points of order 3/2 (their errors add up like noise), and left edges, at the ends of "
            "which there is nothing, of second. On scenes with hard edges every rule is of first order at best: what "
            "part of the interval at a surface is full is a matter of chance."
        ),
        tables=[
            Table("Orders of convergence", orders, ORDERS_NOTE),
            Table("Errors", rows),
        ],
        plots=plots,
        findings=findings,
    )


def methods(field: RadianceField, quick: bool = False) -> dict[str, Method]:
    """Every way to place samples and read density between them, by name."""

    def equal(rule: str, training: bool = False, left: bool = False) -> Method:
        def call(field: RadianceField, rays: Rays, count: int) -> Tensor:
            samples = StratifiedSampler(count, field.box).train(training)(rays, field)  # type: ignore[arg-type]
            if left:
                samples = Samples(samples.starts, samples.ends, samples.num_rays, points=samples.starts)
            return _composite(field, rays, samples, rule)

        return call

    def importance(field: RadianceField, rays: Rays, count: int) -> Tensor:
        half = max(2, count // 2)
        sampler = ImportanceSampler(half, count - half, box=field.box).eval()  # type: ignore[arg-type]
        return _composite(field, rays, sampler(rays, field), "constant")

    found: dict[str, Method] = {
        "constant": equal("constant"), "left edge": equal("constant", left=True),
        "stratified": equal("constant", training=True), "stratified, linear": equal("linear", training=True),
        "linear": equal("linear"), "parabolic": equal("parabolic"), "importance": importance,
    }  # fmt: skip
    box = field.box.tolist()  # type: ignore[operator]
    grid = OccupancyGrid(box, 16 if quick else 40, num_slabs=4 if quick else 16, threshold=1e-3)
    grid.fill(field, 2 if quick else 4)
    guide = OccupancySampler(grid, pad_to=1).eval()

    steps: dict[int, float] = {}

    def occupancy(field: RadianceField, rays: Rays, count: int) -> Tensor:
        if count not in steps:
            steps[count] = _step_for(guide, field, rays, count)
        guide.step_size = steps[count]
        return _composite(field, rays, guide(rays, field), "constant")

    return {**found, "occupancy": occupancy}


def _step_for(guide: OccupancySampler, field: RadianceField, rays: Rays, count: int) -> float:
    """Step with which rays that hit something get `count` samples on average."""
    guide.step_size = 0.02
    samples = guide(rays, field)
    hits = samples.offsets.diff() > 0
    return float(samples.lengths.sum() / hits.sum().clamp(min=1)) / count


def _composite(field: RadianceField, rays: Rays, samples: Samples, rule: str) -> Tensor:
    return composite(samples, field(*samples.locate(rays)), torch.ones(3), quadrature=rule).rgb


def _rays(count: int, seed: int) -> Rays:
    generator = torch.Generator().manual_seed(seed)
    origins = 4 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    targets = 1.2 * torch.rand(count, 3, generator=generator) - 0.6
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    near = torch.full((count,), 2.0)
    return Rays(origins, directions, torch.rand(count, generator=generator), near, near + 4)


def _truth(field: RadianceField, rays: Rays) -> tuple[Tensor, float]:
    """Exact colours (R, 3) on white in float64, and a bound of their own error."""
    exact = rays.to(torch.float64)
    if isinstance(field, SmoothClouds):
        return exact_smooth(field, exact)
    assert isinstance(field, AnalyticScene)
    return render_exact(field, exact, torch.ones(3, dtype=torch.float64))[0], 1e-12


def _error(colors: Tensor, truth: Tensor) -> float:
    return float((colors.double() - truth).abs().amax(-1).square().mean().sqrt())


def _row(
    name: str, method: str, count: int, call: Method, scene: tuple[RadianceField, Rays, Tensor], settings: Settings
) -> dict[str, Any]:
    field, rays, truth = scene
    torch.manual_seed(settings.seed)
    error = _error(call(field, rays, count), truth)
    seconds, repeats = (0.02, 2) if settings.quick else (0.05, 3)
    timed = {"call": lambda: call(field, rays, count)}
    timing = time_in_turn(timed, seconds=seconds, min_repeats=repeats)["call"]
    return {"scene": name, "method": method, "samples_per_ray": count, "rms_error": error, **timing.milliseconds}


def _exact_row(name: str, scene: AnalyticScene, rays: Rays, truth: Tensor) -> dict[str, Any]:
    samples = scene.exact_samples(rays)
    hits = int((samples.offsets.diff() > 0).sum())
    output = scene(*samples.locate(rays))
    colors = composite(samples, FieldOutput(output.density, output.rgb), torch.ones(3)).rgb
    return {
        "scene": name, "method": "exact edges", "samples_per_ray": len(samples.starts) / max(hits, 1),
        "rms_error": _error(colors, truth),
    }  # fmt: skip


def _plot(name: str, rows: list[dict[str, Any]], bound: float) -> Plot:
    series = []
    for method in dict.fromkeys(row["method"] for row in rows):
        part = [row for row in rows if row["method"] == method]
        label = method if len(part) < 3 else f"{method} (order {_order(part):.1f})"
        # Where intervals begin and where their middles are often comes to the same.
        style = "points" if len(part) == 1 else "dashed" if method == "left edge" else "line"
        x, y = [row["samples_per_ray"] for row in part], [row["rms_error"] for row in part]
        series.append(Series(label, x, y, style=style))
    return Plot(
        name=f"quadrature_{name}", title=f"Error against samples per ray, {name}", x_label="samples per ray",
        y_label="root-mean-square error of colour", series=series,
        note=f"Float32; the truth's own error is below {bound:.0e}. Colours lie in [0, 1]: 2e-3 is half an 8-bit step.",
    )  # fmt: skip


def _order(rows: list[dict[str, Any]]) -> float:
    """Order of convergence over the last counts whose error is above rounding and below 0.05."""
    kept = [row for row in rows if ROUNDED < row["rms_error"] < 0.05]
    kept = kept[-4:] if len(kept) >= 2 else rows[-2:]
    return fitted_order([float(r["samples_per_ray"]) for r in kept], [r["rms_error"] for r in kept])


def _orders(name: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    found = []
    for method, theory in THEORY.items():
        part = [row for row in rows if row["method"] == method]
        expected = theory if name == SMOOTH else EDGES
        found.append({"scene": name, "method": method, "fitted_order": _order(part), "theory": expected})
    return found


def samples_needed(rows: list[dict[str, Any]], error: float) -> float:
    """Samples per ray at which a method reaches an error, interpolated on log axes; infinite if it never does."""
    for before, after in pairwise(rows):
        if after["rms_error"] <= error:
            if before["rms_error"] <= error:
                return float(before["samples_per_ray"])
            share = math.log(before["rms_error"] / error) / math.log(before["rms_error"] / after["rms_error"])
            return float(before["samples_per_ray"] * (after["samples_per_ray"] / before["samples_per_ray"]) ** share)
    return math.inf


def _findings(name: str, rows: list[dict[str, Any]], counts: list[int]) -> list[str]:
    midpoints = counts[-2]
    target = next(r["rms_error"] for r in rows if r["method"] == "constant" and r["samples_per_ray"] == midpoints)
    reached, never = [], []
    for method in ("parabolic", "linear", "importance", "occupancy", "stratified, linear"):
        needed = samples_needed([r for r in rows if r["method"] == method], target)
        if math.isfinite(needed):
            reached.append(f"`{method}` {needed / midpoints:.2f}")
        else:
            never.append(f"`{method}`")
    rules = ("parabolic", "linear")
    rule_shares = {m: samples_needed([r for r in rows if r["method"] == m], target) / midpoints for m in rules}
    best = min(rule_shares, key=lambda method: rule_shares[method])
    verdict = (
        f"the {best} rule needs {rule_shares[best]:.2f} times the samples of the midpoint rule"
        if rule_shares[best] < 0.95
        else "neither rule for density gains on the midpoint rule"
    )
    sentence = f"{name}: {verdict}. The error of {midpoints} midpoints ({target:.1e}) takes, in times as many samples, "
    sentence += ", ".join(reached) or "nothing"
    return [sentence + (f"; more than {counts[-1]} samples: {', '.join(never)}." if never else ".")]
