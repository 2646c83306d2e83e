"""What pruning costs and saves: occupancy, transmittance cut-off, steps, and the lattices of deformation and field."""

import copy
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dnerf.benchmarks.scenes import train_model
from dnerf.benchmarks.suite import Plot, Series, Settings, SuiteResult, Table
from dnerf.benchmarks.timing import time_in_turn
from dnerf.data.frames import Frames
from dnerf.deformations import FrameLattice
from dnerf.fields import Baking, DeformedField
from dnerf.renderer import FRAMES_THAT_SHARE, Renderer
from dnerf.samplers import OccupancySampler

PROBES = 2
OWN = ("the experiment's own, one frame", "the experiment's own, a sequence")
FLOOR = 1e-8  # error that is drawn for none

KNOBS = {
    "threshold": "occupancy threshold (1 / world unit)",
    "resolution": "occupancy cells along the longest side",
    "slabs": "occupancy slabs of time",
    "margin": "cells by which what training found is widened in space",
    "cut-off": "transmittance at which a ray ends",
    "step": "step along a ray (world units)",
    "splits": "shortest steps in a marched one, which is split where something is seen, with the cut-off",
    "split weight": "weight in the picture up to which an interval is not split, with the cut-off",
    "lattice": "cells of the lattice that the deformation is kept on",
    "baking": "cells of the lattice that canonical space is kept on",
}


class Setting(NamedTuple):
    """One setting of one knob; all other knobs leave out nothing that can be helped."""

    knob: str
    value: float | None
    sampler: OccupancySampler
    cut: float = 0.0
    lattice: FrameLattice | None = None
    baking: Baking | None = None


def run(settings: Settings) -> SuiteResult:
    """Train a model, then render a few frames with every setting; the reference leaves out nothing."""
    options = settings.options
    parts = train_model(settings)
    renderer, frames = parts["renderer"], parts["data"].frames("test").to(settings.device)
    trained = renderer.sampler
    if not isinstance(trained, OccupancySampler):
        raise ValueError(f"pruning.experiment must sample by occupancy, got {type(trained).__name__}")
    chosen = [0, len(frames) // 2]
    reference = _pictures(_using(renderer, Setting("", None, _everything(trained))), frames, chosen)
    rows = [
        _measure(renderer, setting, frames, chosen, reference, settings)
        for setting in _settings(renderer, trained, options, settings)
    ]
    full = next(row for row in rows if row["knob"] == "nothing left out")
    for row in rows:
        row["times_faster"] = full["median_ms"] / row["median_ms"]
    return SuiteResult(
        title="Pruning: error introduced against time saved",
        summary=(
            f"`experiment={options['experiment']}` trained on `{options['scene']}`; two test frames of "
            f"{frames.intrinsics.width} x {frames.intrinsics.height} pixels rendered in evaluation mode with every "
            "setting of one knob at a time. Occupancy "
            "grids are filled from the finished field (`OccupancySampler.fill`, random probes of every cell), so that "
            "their error is what a setting loses; `as trained` is the grid that training left behind, without its "
            "margin in space if the experiment renders so; `the experiment's own` adds its cut-off and the lattice of "
            "its deformation, and for a sequence that of canonical space, filled before the clock starts, unless haze "
            "forbids it or a kernel asks the field itself as quickly. The "
            f"reference samples the whole box at the experiment's shortest step, {_shortest(trained):g}, and leaves "
            "out nothing: errors are of pruning alone, not of the model. The experiment's own settings: threshold "
            f"{trained.threshold:g}, {int(trained.shape[1:].max())} cells, {int(trained.shape[0])} slabs, cut-off "
            f"{renderer.stop_transmittance:g}."
        ),
        tables=[
            Table(
                "Settings",
                rows,
                "worst_pixel: largest difference of any channel from the reference; psnr_to_reference in dB "
                "(above 60 dB no 8-bit picture changes much).",
            )
        ],
        plots=[_plot(rows, knob) for knob in KNOBS],
        findings=_findings(rows),
    )


def _grid(trained: OccupancySampler, *, resolution: int, num_slabs: int) -> OccupancySampler:
    grid = OccupancySampler(
        trained.box.tolist(), _shortest(trained), resolution, num_slabs=num_slabs, threshold=trained.threshold,
        margin=trained.margin, pad_to=trained.pad_to,
    )  # fmt: skip
    return grid.to(trained.box.device).eval()


def _shortest(trained: OccupancySampler) -> float:
    """Length of the intervals at which the field is asked in the end."""
    return trained.step_size / trained.render_splits


def _everything(trained: OccupancySampler) -> OccupancySampler:
    everything = _grid(trained, resolution=8, num_slabs=1)
    everything.occupy(torch.tensor(True))
    return everything


def _settings(
    renderer: Renderer, trained: OccupancySampler, options: Mapping[str, Any], settings: Settings
) -> Iterator[Setting]:
    slabs, cells = int(trained.shape[0]), int(trained.shape[1:].max())
    if settings.quick:
        slabs, cells = 4, 16
    few = slice(None, None, 3) if settings.quick else slice(None)

    @cache
    def filled(resolution: int, num_slabs: int) -> OccupancySampler:
        grid = _grid(trained, resolution=resolution, num_slabs=num_slabs)
        with torch.no_grad():
            grid.fill(renderer.field, 1 if settings.quick else PROBES)
        return grid

    def changed(**numbers: float) -> OccupancySampler:
        grid = copy.deepcopy(filled(cells, slabs))
        for name, number in numbers.items():
            setattr(grid, name, number)
        grid.decide(is_filled=True)
        return grid

    yield Setting("nothing left out", None, _everything(trained))
    yield Setting("as trained", None, trained)
    field, cut = renderer.field, renderer.stop_transmittance
    own = (field.frame_lattice, field.baking) if isinstance(field, DeformedField) else (None, None)
    yield Setting(OWN[0], None, trained, cut, own[0])
    yield Setting(OWN[1], None, trained, cut, *own)
    for value in options["thresholds"][few]:
        yield Setting("threshold", value, changed(threshold=value))
    for value in options["resolutions"][few]:
        yield Setting("resolution", value, filled(value, slabs))
    for value in options["slabs"][few]:
        yield Setting("slabs", value, filled(cells, value))
    if trained.rendered is not None:
        wide = copy.deepcopy(trained)
        wide.occupy(trained.occupied)
        yield Setting("margin", 1, wide)
        yield Setting("margin", 0, trained)
    for value in options["steps"][few]:
        yield Setting("step", value, changed(step_size=value))
    for value in options["splits"][few]:
        yield Setting("splits", value, changed(step_size=value * _shortest(trained), render_splits=value), cut)
    own_splits = {"step_size": trained.step_size, "render_splits": trained.render_splits}
    for value in options["split_weights"][few] if trained.render_splits > 1 else []:
        yield Setting("split weight", value, changed(**own_splits, split_weight=value), cut)
    for value in options["cuts"][few]:
        yield Setting("cut-off", value, trained, value)
    for value in options["lattices"][few]:
        yield Setting("lattice", value, trained, 0.0, FrameLattice(trained.box.tolist(), value))
    can_bake = isinstance(field, DeformedField) and field.canonical.num_contents > 0
    for value in options["bakings"][few] if can_bake else []:
        yield Setting("baking", value, trained, 0.0, None, Baking(trained.box.tolist(), value))


def _using(renderer: Renderer, setting: Setting) -> Renderer:
    """A renderer of the same model with a setting."""
    field = renderer.field
    if isinstance(field, DeformedField):
        field = DeformedField(
            field.deformation, field.canonical,
            frame_lattice=setting.lattice, baking=setting.baking, bodies=field.bodies,
        )  # fmt: skip
    changed = Renderer(
        field if setting.knob in OWN else field.finished(), setting.sampler, renderer.background,
        precision=renderer.precision, stop_transmittance=setting.cut, quadrature=renderer.quadrature,
    )  # fmt: skip
    return (changed.for_sequence(FRAMES_THAT_SHARE) if setting.knob == OWN[1] else changed).eval()


def _pictures(renderer: Renderer, frames: Frames, chosen: list[int]) -> Tensor:
    return torch.stack([renderer.render_image(frames.camera(i), float(frames.times[i])).rgb for i in chosen])


def _measure(
    renderer: Renderer, setting: Setting, frames: Frames, chosen: list[int], reference: Tensor, settings: Settings
) -> dict[str, Any]:
    changed = _using(renderer, setting)

    def call() -> Tensor:
        return _pictures(changed, frames, chosen)

    difference = (call() - reference).abs()
    error = float(difference.square().mean())
    timing = time_in_turn(
        {"call": call}, seconds=0.1 if settings.quick else 1.0, min_repeats=2 if settings.quick else 3,
        device=settings.device,
    )["call"]  # fmt: skip
    sampler = setting.sampler
    samples = sum(_num_samples(renderer, sampler, frames, i) for i in chosen)
    occupied = sampler.occupied if sampler.rendered is None else sampler.rendered
    return {
        "knob": setting.knob,
        "value": setting.value,
        "occupied": float(occupied.float().mean()),
        "samples_per_ray": samples / (len(chosen) * frames.intrinsics.width * frames.intrinsics.height),
        "rms_error": error**0.5,
        "worst_pixel": float(difference.max()),
        "psnr_to_reference": -10 * torch.tensor(max(error, 1e-14)).log10().item(),
        **{name: number / len(chosen) for name, number in timing.milliseconds.items()},
        "grid_MiB": sum(b.nbytes for b in (sampler.occupied, sampler.maxima, sampler.skips)) / 2**20,
    }


@torch.no_grad()
def _num_samples(renderer: Renderer, sampler: OccupancySampler, frames: Frames, index: int) -> int:
    samples = sampler(frames.camera(index).rays(float(frames.times[index])), renderer.field)
    return int((samples.lengths > 0).sum())


def _plot(rows: list[dict[str, Any]], knob: str) -> Plot:
    """One knob's settings beside what is left out by none and by the grid as training left it."""
    series = []
    for name in ("nothing left out", "as trained", *OWN, knob):
        part = [row for row in rows if row["knob"] == name]
        x, y = [row["median_ms"] for row in part], [max(row["rms_error"], FLOOR) for row in part]
        notes = ["" if row["value"] is None else f"{row['value']:g}" for row in part]
        low, high = ([row[end] for row in part] for end in ("low_ms", "high_ms"))
        style = "line" if name == knob else "points"
        series.append(Series(name, x, y, x_low=low, x_high=high, notes=notes, style=style))
    return Plot(
        name=f"pruning_{knob.replace(' ', '_')}",
        title=f"Error against time: {KNOBS[knob]}",
        x_label="time per frame (ms)",
        y_label="root-mean-square difference from leaving out nothing",
        series=series,
        note="Down and left is better; numbers are the knob's value, bars the quartiles of time. Half an 8-bit step is "
        "2e-3; 1e-8 stands for no error.",
    )


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    findings = []
    for knob, what in KNOBS.items():
        good = [row for row in rows if row["knob"] == knob and row["rms_error"] < 1e-3]
        if good:
            best = max(good, key=lambda row: row["times_faster"])
            findings.append(
                f"{what}: the fastest below an error of 1e-3 is {best['value']:g}, {best['times_faster']:.1f} times "
                f"faster than leaving out nothing, error {best['rms_error']:.1e}, worst {best['worst_pixel']:.1e}."
            )
    return findings
