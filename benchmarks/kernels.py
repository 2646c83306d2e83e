"""Each kernel against its definition, against the best plain-torch form and against the machine's limit."""

import math
from typing import Any

import torch

from benchmarks.image_cases import image_cases
from benchmarks.kernel_cases import COMPILED, PLAIN, REFERENCE, Case, Workload, training_cases
from benchmarks.machine import Rates, measure_rates
from benchmarks.suite import BarPlot, Settings, SuiteResult, Table
from benchmarks.timing import num_threads, recorded, time_in_turn

RAYS = {"cpu": (512, 2048, 8192), "cuda": (1024, 8192, 65536)}  # of a batch
RUNS = 20  # of a call in a CUDA graph


def run(settings: Settings) -> SuiteResult:
    """Time every kernel, forward and backward, on the samples of a batch of rays through a hollow ball."""
    counts = (256, 1024) if settings.quick else RAYS[settings.device]
    cores = torch.get_num_threads()
    rates = measure_rates(settings.device, seconds=0.15 if settings.quick else 1.0)
    rows: list[dict[str, Any]] = []
    for num_rays in counts:
        work = Workload(num_rays, settings)
        cases = training_cases(work) + ([] if settings.device == "cuda" else image_cases(work))
        for threads in [cores] if cores == 1 or num_rays != counts[-1] else [1, cores]:
            with num_threads(threads):
                for case in cases:
                    rows += _measure(case, work.num_samples, threads, rates, settings)
    most = max(row["samples"] for row in rows)
    largest = [row for row in rows if row["samples"] == most and row["threads"] == cores]
    return SuiteResult(
        title="Kernels: compiled, by definition, in plain torch, and the machine's limit",
        summary=(
            "Every kernel of `dnerf/kernels` is timed on the samples of rays through an occupied spherical shell, as a "
            "training step of `experiment=fast` has them (`footprints`: a frame; `skip_distances`: "
            "a whole grid, for any samples): the compiled version (numba or oneDNN on CPUs, "
            "Triton on a GPU), the reference that defines it, and the quickest form in plain torch that we know. "
            "Variants run in turn; medians with quartiles. On a GPU calls are replayed from a CUDA graph, as training "
            "does, where they do not wait for the device. The limit is the least number of bytes (inputs, outputs and "
            "table rows in use, once each) at the copy bandwidth measured in the same run; a gather from a table that "
            "fits into a cache reads each row many times, so no program reaches it."
        ),
        tables=[
            Table("Times", rows, "times_compiled: how many times the compiled version's median; times_limit likewise."),
            Table("Limits measured in this run", rates.rows()),
        ],
        plots=[_plot(largest, direction) for direction in ("forward", "forward + backward")],
        findings=_findings(largest),
    )


def _measure(case: Case, samples: int, threads: int, rates: Rates, settings: Settings) -> list[dict[str, Any]]:
    seconds = 0.3 if settings.quick else 1.0
    replays = {}
    if settings.device == "cuda":
        replays = {name: graph for name, call in case.calls.items() if (graph := recorded(call, RUNS))}
    timings = time_in_turn({**case.calls, **replays}, seconds=seconds, min_repeats=3, device=settings.device)
    timings = {name: timing.of_each(RUNS if name in replays else 1) for name, timing in timings.items()}
    limit = case.num_bytes / rates.bandwidth
    return [
        {
            "kernel": case.kernel, "direction": case.direction, "samples": samples, "threads": threads,
            "variant": variant, "replayed": variant in replays, **timing.milliseconds,
            "times_compiled": timing.median / timings[COMPILED].median, "limit_ms": 1e3 * limit,
            "times_limit": timing.median / limit,
        }
        for variant, timing in timings.items()
    ]  # fmt: skip


def _plot(rows: list[dict[str, Any]], direction: str) -> BarPlot:
    """Milliseconds of every kernel's variants."""
    found = {(row["kernel"], row["variant"]): row["median_ms"] for row in rows if row["direction"] == direction}
    kernels = list(dict.fromkeys(kernel for kernel, _ in found))
    return BarPlot(
        "kernels_" + direction.replace(" + ", "_"), f"Time of {rows[0]['samples']:,} samples, {direction}",
        "milliseconds", kernels,
        {v: [found.get((kernel, v), math.nan) for kernel in kernels] for v in (COMPILED, PLAIN, REFERENCE)},
        "Shorter is better.", log=True,
    )  # fmt: skip


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    findings = []
    for kernel, direction in dict.fromkeys((row["kernel"], row["direction"]) for row in rows):
        part = {r["variant"]: r for r in rows if r["kernel"] == kernel and r["direction"] == direction}
        others = [f"{v} takes {part[v]['times_compiled']:.3g} x as long" for v in (REFERENCE, PLAIN) if v in part]
        own = part[COMPILED]
        findings.append(
            f"{kernel}, {direction}, {own['samples']:,} samples: {own['median_ms']:.3g} ms compiled, "
            f"{own['times_limit']:.3g} x its least traffic; {', '.join(others)}."
        )
    return findings
