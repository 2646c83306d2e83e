"""Where the milliseconds of one training step go, against the floor, on one core and on all."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch.profiler import ProfilerActivity, record_function

from benchmarks.machine import Rates, measure_rates
from benchmarks.operations import LAYER, OperationCounter, Work, total
from benchmarks.scenes import scene_overrides
from benchmarks.suite import BarPlot, Settings, SuiteResult, Table
from benchmarks.timing import Timing, summarize
from dnerf.fields.base import RadianceField
from dnerf.rendering.renderer import Renderer
from dnerf.training.run import Callback, Run

UPDATE = "occupancy update"
BETWEEN = "Python and dispatch between operations"
OTHER = "other element-wise operations"
PARTS: dict[str, tuple[str, ...]] = {
    "matrix products": (
        "aten::mm", "aten::addmm", "aten::bmm", "aten::baddbmm", "aten::_addmm_activation", LAYER,
        "dnerf::relu_layers",
    ),
    "densities without gradients: grid encoding and its network": ("dnerf::grid_network",),
    "grid encoding, forward": ("dnerf::grid_encode",),
    "grid encoding, gradient to the table": ("dnerf::grid_encode_grad_table",),
    "grid encoding, gradient to positions": ("dnerf::grid_encode_grad_positions",),
    "marching rays": ("dnerf::march",),
    "compositing, forward and backward": (
        "dnerf::packed_weights", "dnerf::packed_weights_grad", "dnerf::packed_sum", "dnerf::packed_sum_grad_values",
        "dnerf::packed_sum_grad_weights",
    ),
    "series in time and direction": (
        "dnerf::series_sums", "dnerf::series_sums_grad_coefficients", "dnerf::series_sums_grad_basis",
    ),
    "optimiser": ("aten::_fused_adam_",),
    "sines and cosines": ("aten::sin", "aten::cos"),
    "activations, forward and backward": (
        "aten::relu", "aten::clamp_min", "aten::threshold_backward", "aten::sigmoid", "aten::sigmoid_backward",
        "aten::exp", "aten::softplus", "aten::softplus_backward",
    ),
    "copies, casts and concatenations": ("aten::copy_", "aten::_to_copy", "aten::cat", "aten::clone"),
    "gathering pixels and rays": ("aten::index", "aten::index_select", "aten::gather", "aten::randint"),
}  # fmt: skip
WINDOW = 20  # steps between two looks at the clock
NUM_TIMED, NUM_PROFILED = 6, 2  # windows for each number of threads


def run(settings: Settings) -> SuiteResult:
    """Train a little, then time, profile and count the same steps."""
    options = settings.options
    warm = 2 * WINDOW if settings.quick else max(WINDOW, options["warm_steps"] // WINDOW * WINDOW)
    cores = torch.get_num_threads()
    threads = [1] if cores == 1 else [1, cores]
    timed = 2 if settings.quick else NUM_TIMED
    rates = {}
    for count in threads:
        torch.set_num_threads(count)
        rates[count] = measure_rates(settings.device, seconds=0.15 if settings.quick else 1.0)
    torch.set_num_threads(cores)
    num_steps = warm + WINDOW * (len(threads) * (timed + NUM_PROFILED) + 1)
    overrides = scene_overrides(options["scene"], 80 if settings.quick else 100, options["data_root"], settings.quick)
    parts = settings.parts(
        *options["overrides"], *overrides, f"trainer.num_steps={num_steps}", "trainer.max_seconds=null",
        f"trainer.log_every={WINDOW}",
    )  # fmt: skip
    renderer, trainer = parts["renderer"].to(settings.device), parts["trainer"]
    probe = Probe(renderer, warm, threads, timed, rates[cores], settings.device)
    trainer.callbacks = {"probe": probe}  # the clock stands still while others act, anyhow
    trainer.fit(renderer, parts["data"].frames("train"), seed=settings.seed)
    return _result(probe, rates, settings)


class Probe(Callback):
    """Times windows of steps in turn on each number of threads, then profiles, then counts.

    Args:
        renderer: in training.
        warm: steps left alone at first, a multiple of the window.
        threads: numbers of threads.
        num_timed: windows timed for each.
        rates: of the machine on all cores.
        device: where it runs.
    """

    def __init__(
        self, renderer: Renderer, warm: int, threads: list[int], num_timed: int, rates: Rates, device: str
    ) -> None:
        self.warm = warm
        self.threads = threads
        self.device = device
        self.seconds: dict[int, list[float]] = {count: [] for count in threads}
        self.profiled_seconds: dict[int, float] = dict.fromkeys(threads, 0.0)
        self.events: dict[int, dict[str, float]] = {}
        self.counter = OperationCounter(rates)
        self.num_samples: list[int] = []
        self.num_rays: list[int] = []
        self._plan = self._windows(num_timed)
        self._active: tuple[str, int] | None = None
        self._context: AbstractContextManager[Any] | None = None
        self._last = 0.0
        update = renderer.sampler.update

        def annotated(field: RadianceField, step: int) -> None:
            with record_function(UPDATE):
                update(field, step)

        # An attribute of this one object, so that its probes are not taken for those of the step itself.
        renderer.sampler.update = annotated  # type: ignore[method-assign]

    def _windows(self, num_timed: int) -> Iterator[tuple[str, int]]:
        for _ in range(num_timed):
            yield from (("time", count) for count in self.threads)
        for count in self.threads:
            yield from [("profile", count)] * NUM_PROFILED
        yield "count", self.threads[-1]

    def on_step_end(self, run: Run) -> None:
        """End a window and begin the next."""
        if run.step < self.warm or run.step % WINDOW:
            return
        if self._active is not None:
            self._end(run)
        self._active = next(self._plan, None)
        if self._active is None:
            return
        kind, count = self._active
        torch.set_num_threads(count)
        if kind == "profile":
            activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * (self.device == "cuda")
            self._context = torch.profiler.profile(activities=activities)
        elif kind == "count":
            self._context = self.counter
        if self._context is not None:
            self._context.__enter__()
        self._last = run.seconds

    def _end(self, run: Run) -> None:
        assert self._active is not None
        assert run.record is not None
        kind, count = self._active
        context, self._context = self._context, None
        if context is not None:
            context.__exit__(None, None, None)
        taken = (run.seconds - self._last) / WINDOW
        if kind == "time":
            self.seconds[count].append(taken)
            self.num_samples.append(run.record.num_samples)
            self.num_rays.append(run.record.num_rays)
        elif kind == "profile":
            self.profiled_seconds[count] += taken / NUM_PROFILED
            self._add_events(context, count)

    def _add_events(self, profiler: Any, count: int) -> None:
        seconds = self.events.setdefault(count, defaultdict(float))
        for event in profiler.events():
            part = _part_of(event)
            own = event.self_device_time_total if self.device == "cuda" else event.self_cpu_time_total
            seconds[part] += own * 1e-6 / (WINDOW * NUM_PROFILED)


def _part_of(event: Any) -> str:
    """What a profiled operation belongs to: its own kind, or that of the kernel or update that it ran within."""
    around = []
    while event is not None:
        around.append(event.name)
        event = event.cpu_parent
    if UPDATE in around:
        return UPDATE
    kernel = next((name for name in around if name.startswith("dnerf::")), around[0])
    return next((part for part, names in PARTS.items() if kernel in names), OTHER)


def _floors(work: Mapping[str, Work]) -> dict[str, Work]:
    floors = {part: total(work, set(names)) for part, names in PARTS.items()}
    known = {name for names in PARTS.values() for name in names}
    floors[OTHER] = total(work, set(work) - known)
    return floors


def _result(probe: Probe, rates: Mapping[int, Rates], settings: Settings) -> SuiteResult:
    cores = probe.threads[-1]
    timings = {count: summarize(values) for count, values in probe.seconds.items()}
    parts = {count: _scaled_parts(probe, count, timings[count]) for count in probe.threads}
    floors = _floors(probe.counter.work)
    names = sorted(parts[cores], key=lambda part: -parts[cores][part])
    rows = [_row(part, parts, floors, probe, timings[cores]) for part in names]
    samples, rays = (round(sum(v) / len(v)) for v in (probe.num_samples, probe.num_rays))
    steps = [
        {
            "threads": count, **timing.milliseconds, "steps_per_second": 1 / timing.median,
            "samples_per_step": samples, "rays_per_step": rays, "times_one_core": timings[1].median / timing.median,
        }
        for count, timing in timings.items()
    ]  # fmt: skip
    floor = sum(f.seconds for f in floors.values()) / WINDOW
    columns = {f"{n} thread{'s' * (n > 1)}": [1e3 * parts[n].get(part, 0.0) for part in names] for n in probe.threads}
    columns["floor"] = [1e3 * floors[part].seconds / WINDOW if part in floors else float("nan") for part in names]
    plot = BarPlot("profile_parts", "Where one training step's time goes", "milliseconds per step", names, columns)
    limits = [{"threads": count, **row} for count, rate in rates.items() for row in rate.rows()]
    return SuiteResult(
        title="Profile of one training step",
        summary=(
            f"Steps of `{' '.join(settings.options['overrides'])}` on `{settings.options['scene']}` after a warm-up, "
            "timed without a profiler in windows that alternate between one thread and all, then profiled "
            "(`torch.profiler`, self time of every operation), then counted (operands of every operation, flops of "
            "matrix products). The parts are scaled to the step's time without a profiler. The floor of an operation "
            "is the longer of its arithmetic at the matrix rate and its operands at the copy bandwidth, both measured "
            f"in this run; operands that stay in a cache may beat it. The `{UPDATE}` (random probes of the field, "
            "every 16 steps) is shown as one part and averaged over all steps; the counted work of its probes is "
            "within the floors of the operations that it is made of."
        ),
        tables=[
            Table("Steps", steps),
            Table("Parts of a step", rows, "Milliseconds, calls, traffic and arithmetic per step."),
            Table("Limits measured in this run", limits),
        ],
        plots=[plot],
        findings=[
            f"One step takes {1e3 * timings[n].median:.3g} ms on {n} thread{'s' * (n > 1)}." for n in probe.threads
        ]
        + [
            f"Its floor at the measured rates is {1e3 * floor:.3g} ms: the step is "
            f"{timings[cores].median / floor:.2g} times above it.",
            "Largest parts: " + ", ".join(f"{row['part']} {row['share']:.0%}" for row in rows[:3]) + ".",
        ],
    )


def _scaled_parts(probe: Probe, count: int, timing: Timing) -> dict[str, float]:
    """Seconds per step of every part, scaled from the profiled step's time to the undisturbed one's."""
    seconds = dict(probe.events[count])
    seconds[BETWEEN] = max(0.0, probe.profiled_seconds[count] - sum(seconds.values()))
    scale = timing.median / max(probe.profiled_seconds[count], sum(seconds.values()))
    return {part: value * scale for part, value in seconds.items()}


def _row(
    part: str, parts: dict[int, dict[str, float]], floors: dict[str, Work], probe: Probe, timing: Timing
) -> dict[str, Any]:
    cores = probe.threads[-1]
    milliseconds = 1e3 * parts[cores][part]
    row: dict[str, Any] = {"part": part, "ms": milliseconds, "share": parts[cores][part] / timing.median}
    if len(probe.threads) > 1:
        row["ms_one_core"] = 1e3 * parts[1].get(part, 0.0)
        row["times_one_core"] = row["ms_one_core"] / milliseconds if milliseconds else None
    work = floors.get(part)
    floor = None if work is None else 1e3 * work.seconds / WINDOW
    row |= {
        "floor_ms": floor,
        "times_floor": milliseconds / floor if floor else None,
        "calls": None if work is None else work.calls / WINDOW,
        "MB": None if work is None else work.num_bytes / WINDOW / 1e6,
        "Mflop": None if work is None else work.flops / WINDOW / 1e6,
    }
    return row
