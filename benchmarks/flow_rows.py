"""What a flow costs and how right it is: solvers and variants. Each function returns rows of a table."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from benchmarks.closed_flows import CLOSED_FLOWS, ClosedFlow, count_evaluations
from benchmarks.suite import Row
from benchmarks.timing import Timing, time_in_turn
from dnerf.core.checks import check_positive
from dnerf.deformations import (
    Deformation,
    DisplacementDeformation,
    FlowChain,
    FlowDeformation,
    IntegrationError,
    SE3Deformation,
)
from dnerf.deformations.solvers import ADAPTIVE_SOLVERS, FIXED_SOLVERS
from dnerf.deformations.velocities import NetworkVelocity, Velocity

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
STEPS = (1, 2, 4, 8, 16, 32, 64)
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
NUM_FRAMES = 100  # distinct times of samples
RAYS_PER_SAMPLE = 1 / 12


def timed(function: Callable[[], object], repeats: int, device: str) -> Timing:
    """Median and quartiles of a call's time, after one that is not counted."""
    return time_in_turn({"call": function}, seconds=1e-9, min_repeats=repeats, device=device)["call"]


def smooth_network() -> NetworkVelocity:
    """A smooth network velocity that moves points by about half a unit over one unit of time; always the same."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        velocity = NetworkVelocity(BOX, 3, 64, position_frequencies=1, time_frequencies=2)
        assert velocity.mlp.output is not None
        torch.nn.init.normal_(velocity.mlp.output.weight, std=0.1)
    return velocity


def solver_rows(
    fields: Sequence[str] = (*CLOSED_FLOWS, "network"), *, num_points: int = 4096, steps: Sequence[int] = STEPS,
    tolerances: Sequence[float] = TOLERANCES, repeats: int = 3, device: str = "cpu",
) -> list[Row]:  # fmt: skip
    """Error of every solver against its function evaluations and milliseconds, in float64.

    Points in [-1, 1]^3 at random times in [0, 1] are carried to time 0. The truth is the closed form, or for
    "network" RK4 with 512 steps.

    Args:
        fields: names of `CLOSED_FLOWS`, or "network" (a smooth network of 3 x 64).
        num_points: carried at a time.
        steps: of the fixed-step solvers.
        tolerances: of the adaptive ones, relative and absolute.
        repeats: timed calls of each.
        device: where to compute.

    Returns:
        Rows of field, solver, setting, evaluations, milliseconds (median_ms and the quartiles low_ms and high_ms),
        max_error, mean_error and round_trip (largest distance after the way there and the uncorrected way back,
        infinite if that fails), in world units.
    """
    check_positive("num_points", num_points)
    generator = torch.Generator().manual_seed(0)
    positions = (torch.rand(num_points, 3, generator=generator, dtype=torch.float64) * 2 - 1).to(device)
    times = torch.rand(num_points, generator=generator, dtype=torch.float64).to(device)
    settings: list[tuple[str, str, dict[str, Any]]] = [
        (solver, f"{n} steps", {"num_steps": n}) for solver in FIXED_SOLVERS for n in steps
    ]
    settings += [
        (solver, f"tolerance {tolerance:g}", {"rtol": tolerance, "atol": tolerance, "max_steps": 100_000})
        for solver in ADAPTIVE_SOLVERS
        for tolerance in tolerances
    ]
    rows: list[Row] = []
    for field in fields:
        velocity = (smooth_network() if field == "network" else CLOSED_FLOWS[field]()).double().to(device)
        truth = _truth(velocity, positions, times)
        for solver, setting, arguments in settings:
            measured = _measure(FlowDeformation(velocity, solver=solver, **arguments), positions, times, truth, repeats)
            rows.append({"field": field, "solver": solver, "setting": setting, **measured})
    return rows


@torch.no_grad()
def _truth(velocity: Velocity, positions: Tensor, times: Tensor) -> Tensor:
    if isinstance(velocity, ClosedFlow):
        return velocity.carry(positions, times, torch.zeros_like(times))
    return FlowDeformation(velocity, num_steps=512)(positions, times)


@torch.no_grad()
def _measure(flow: FlowDeformation, positions: Tensor, times: Tensor, truth: Tensor, repeats: int) -> dict[str, Any]:
    timing = timed(lambda: flow(positions, times), repeats, positions.device.type)
    evaluations = count_evaluations(flow, flow, positions, times)
    carried = flow(positions, times)
    errors = (carried - truth).norm(dim=-1)
    return {
        "evaluations": evaluations, **timing.milliseconds, "max_error": float(errors.max()),
        "mean_error": float(errors.mean()), "round_trip": _round_trip(flow, carried, times, positions),
    }  # fmt: skip


def _round_trip(flow: FlowDeformation, carried: Tensor, times: Tensor, positions: Tensor) -> float:
    try:
        return float((flow.reverse(carried, times) - positions).norm(dim=-1).max())
    except IntegrationError:
        return math.inf


def variants() -> dict[str, Deformation]:
    """Deformations whose costs are compared, untrained, at the sizes that `conf/deformation` gives them, and others."""

    def network(**changes: Any) -> NetworkVelocity:
        return NetworkVelocity(BOX, **{"hidden_features": 128, "activation": "relu", "smoothness": 1, **changes})

    def stationary(solver: str = "midpoint", **changes: Any) -> FlowDeformation:
        return FlowDeformation(network(**changes), None, velocity_in_time="stationary", solver=solver, num_steps=1)

    def varying(velocity: Velocity, solver: str = "midpoint", num_steps: int = 2) -> FlowDeformation:
        return FlowDeformation(velocity, 0.5, solver=solver, num_steps=num_steps)

    def chain(**changes: Any) -> FlowChain:
        return FlowChain({name: stationary("euler", **changes) for name in ("first", "second")})

    small: dict[str, Any] = {"position_frequencies": 3, "time_frequencies": 5, "canonical_time": None}
    return {
        "displacement (4 x 128)": DisplacementDeformation(4, 128, (), **small),
        "SE(3) (4 x 128)": SE3Deformation(4, 128, (), **small),
        "flow, chain of 2 Euler steps (3 x 128)": chain(),
        "flow, chain of 2 Euler steps (2 x 128)": chain(num_layers=2),
        "flow, stationary, 1 midpoint step (3 x 128)": stationary(),
        "flow, stationary, 1 midpoint step (3 x 64)": stationary(hidden_features=64),
        "flow, varying, 2 midpoint steps (3 x 128)": varying(network()),
        "flow, varying, 8 RK4 steps (3 x 64, silu)": varying(NetworkVelocity(BOX, 3, 64), "rk4", 8),
    }


def variant_rows(
    names: Sequence[str] = (), *, num_samples: int = 24576, repeats: int = 10,
    precision: torch.dtype | None = torch.bfloat16, device: str = "cpu",
) -> list[Row]:  # fmt: skip
    """Milliseconds of every variant for the samples of one training step, beside the displacement network's.

    Samples lie near the surface of an ellipsoid, grouped in rays, each ray with the time of one of the frames.

    Args:
        names: of `variants`; all if empty.
        num_samples: per call.
        repeats: timed calls of each.
        precision: of networks under autocast; None for float32.
        device: where to compute.

    Returns:
        Rows of variant, evaluations, forward_ms, training_ms (forward and backward, median and quartiles) and ratio
        (of training_ms to the first row's).
    """
    made = variants()
    unknown = set(names) - set(made)
    if unknown:
        raise ValueError(f"names must be some of {', '.join(made)}; got {', '.join(sorted(unknown))}")
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(num_samples, 3, generator=generator), dim=-1)
    noise = 0.05 * torch.randn(num_samples, 3, generator=generator)
    positions = (directions * torch.tensor([0.3, 0.3, 0.9]) + noise).to(device)
    num_rays = max(1, round(num_samples * RAYS_PER_SAMPLE))
    of_rays = torch.randint(NUM_FRAMES, (num_rays,), generator=generator) / (NUM_FRAMES - 1)
    times = of_rays[torch.arange(num_samples) * num_rays // num_samples].to(device)
    rows: list[Row] = []
    for name in names or made:
        deformation = made[name].to(device)

        def forward(deformation: Deformation = deformation) -> Tensor:
            with torch.autocast(positions.device.type, dtype=precision, enabled=precision is not None):
                return deformation(positions, times)

        def step(forward: Callable[[], Tensor] = forward) -> None:
            forward().sum().backward()

        with torch.no_grad():
            forward_time = timed(forward, repeats, device)
        training = timed(step, repeats, device)
        evaluations = count_evaluations(deformation, forward) or 1
        rows.append({
            "variant": name, "evaluations": evaluations, "forward_ms": 1e3 * forward_time.median,
            "training_ms": 1e3 * training.median, "training_low_ms": 1e3 * training.low,
            "training_high_ms": 1e3 * training.high,
            "ratio": 1e3 * training.median / (rows[0]["training_ms"] if rows else 1e3 * training.median),
        })  # fmt: skip
    return rows
