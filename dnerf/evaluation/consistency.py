"""Checks that a model is consistent over time.

Each check measures one number and compares it with a stated bound. Images are compared on the rays that show something
at some time; "change" is the mean absolute difference of their colours.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dnerf.core.checks import as_box
from dnerf.core.compositing import Rendering
from dnerf.core.rays import Rays
from dnerf.motion import MotionModel, follow, motion_model
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler

Images = Callable[[Rays], Rendering]  # What gives images of rays: a renderer in evaluation mode, or an exact scene

LEVEL = 1 / 255  # One step of an 8-bit image
WEBER = 0.01  # Smallest relative step of brightness that people see (Weber's fraction is 1 to 2 %)
# Least orders of continuity: halfway from a jump (0) to a sharp edge (1/2), and from there to a smooth field (1).
SHARP, SMOOTH = 0.25, 0.75
SLOPE_OVER = 8
NUM_SAMPLES = 64
NUM_TIMES = 9
GAP = 1e-5  # of time, within which smooth motion changes nothing visible


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    check: str  # its name
    value: float | None  # what was measured; None if there was nothing to measure
    bound: float  # what it is compared with
    passed: bool | None  # whether it keeps the bound; None if not measured
    meaning: str  # in words, with the unit

    def __str__(self) -> str:
        verdict = {True: "passed", False: "FAILED", None: "not measured"}[self.passed]
        value = "" if self.value is None else f"{self.value:.3g}"
        return f"{self.check:20} {verdict:13} {value:>9} {self.bound:>9.3g}  {self.meaning}"


@torch.no_grad()
def check_consistency(
    renderer: Renderer, rays: Rays, box: Sequence[Sequence[float]] | Tensor | None, *, slabs: int = 1,
    truth: Images | None = None, train_times: Sequence[float] = (),
) -> list[Finding]:  # fmt: skip
    """All checks that a model allows.

    Args:
        rays: R rays of one view, whose times are unused; ValueError if they show nothing at any time.
        box: (2, 3) corners of what is modelled, in world units; None for all between the rays' planes.
        slabs: of equal length that the sampler divides time into.
        truth: the exact images, if they are known.
    """
    with renderer.evaluating():
        # The field alone: what a sampler leaves out may change from slab to slab, which the second check looks at.
        sampler = StratifiedSampler(NUM_SAMPLES, None if box is None else as_box(box))
        plain = Renderer(renderer.field, sampler, renderer.background).eval()
        findings = [check_continuity(plain, rays, num_times=17)]
        if slabs > 1:
            findings.append(check_popping(renderer, rays, [k / slabs for k in range(1, slabs)], most=WEBER))
        motion = motion_model(renderer)
        if motion is not None:
            findings.append(check_colour_along_tracks(renderer, motion, rays))
        if truth is not None:
            findings.append(check_closing(renderer, rays, truth))
            if len(train_times) > 1:
                findings.append(check_unseen_times(renderer, truth, rays, train_times))
    return findings


@torch.no_grad()
def images_over_time(images: Images, rays: Rays, times: Tensor, *, chunk: int = 16384) -> tuple[Tensor, Tensor]:
    """Colours (T, R, 3) and opacities (T, R) of R rays at T times; the rays' own times are unused."""
    colors, opacities = [], []
    for some in times.to(rays.times).split(max(1, chunk // len(rays))):
        count = len(some)
        repeated = rays[torch.arange(len(rays), device=rays.times.device).repeat(count)]
        rendering = images(replace(repeated, times=some.repeat_interleave(len(rays))))
        colors.append(rendering.rgb.reshape(count, len(rays), 3))
        opacities.append(rendering.opacity.reshape(count, len(rays)))
    return torch.cat(colors), torch.cat(opacities)


def hitting_rays(images: Images, rays: Rays) -> Rays:
    """The rays that show something at one of nine times; ValueError if none does."""
    _, opacity = images_over_time(images, rays, torch.linspace(0, 1, NUM_TIMES))
    hits = (opacity > 0.05).any(0)
    if not bool(hits.any()):
        raise ValueError("rays must show something at some time, none does")
    return rays[hits]


def check_continuity(
    images: Images, rays: Rays, *, num_times: int = 33, num_halvings: int = 12, least_order: float = SHARP
) -> Finding:
    """Frames at t and t + h converge to each other at the expected order as h goes to 0.

    The four intervals of time over which the image changes most are halved again and again, keeping the halves with the
    largest change: where the image jumps, the change stays; where it is Lipschitz, it halves. The order is the
    least-squares slope of log2 change over the last eight halvings.

    A jump has order 0. Bodies with a sharp edge have order 1/2: the chord of a ray through a ball grows with the root
    of how deep it dips. Smooth fields have order 1. `SHARP` and `SMOOTH` lie halfway between neighbours. Where in its
    interval a ray meets an edge is as good as random, which scatters each log2 change by 0.72 at most and the slope of
    nine by 0.72 / sqrt(60) = 0.09: an edge is more than two standard deviations from either bound.

    Args:
        rays: R rays; in double precision, steps of time may be as small as one likes.
        num_times: even steps among which the search begins.
        num_halvings: at least 8 (else ValueError); in single precision, the last step should stay above 1e-5.
    """
    if num_halvings < SLOPE_OVER:
        raise ValueError(f"num_halvings must be at least {SLOPE_OVER}, got {num_halvings}")
    rays = hitting_rays(images, rays)
    times = torch.linspace(0, 1, num_times, dtype=torch.float64)
    colors, _ = images_over_time(images, rays, times)
    intervals = [
        (_change(colors[i], colors[i + 1]), float(times[i]), float(times[i + 1]), colors[i], colors[i + 1])
        for i in range(num_times - 1)
    ]
    if max(interval[0] for interval in intervals) < 1e-4 * LEVEL:
        return Finding("time continuity", math.inf, least_order, True, "order in h of the change; nothing changes")
    worst = []
    for _ in range(num_halvings + 1):
        intervals = sorted(intervals, key=lambda interval: -interval[0])[:4]
        worst.append(intervals[0][0])
        middles = [0.5 * (start + end) for _, start, end, _, _ in intervals]
        between, _ = images_over_time(images, rays, torch.tensor(middles, dtype=torch.float64))
        halves = []
        for (_, start, end, first, last), middle, image in zip(intervals, middles, between):
            halves.append((_change(first, image), start, middle, first, image))
            halves.append((_change(image, last), middle, end, image, last))
        intervals = halves
    # An image that no longer changes at all is below rounding: nothing jumps.
    logarithms = [math.log2(max(change, 1e-30)) for change in worst[-SLOPE_OVER - 1 :]]
    centered = [i - SLOPE_OVER / 2 for i in range(SLOPE_OVER + 1)]
    order = -sum(c * y for c, y in zip(centered, logarithms)) / sum(c * c for c in centered)
    return Finding("time continuity", order, least_order, order >= least_order, "order in h of the change, at least")


def check_popping(images: Images, rays: Rays, boundaries: Sequence[float], *, most: float = 0.5 * LEVEL) -> Finding:
    """The image does not jump at `boundaries`, times in (0, 1) where slabs or cells of time meet.

    `most` is the largest change from right before to right behind one: half an 8-bit level is what rounding hides,
    `WEBER` what nobody sees.
    """
    rays = hitting_rays(images, rays)
    times = torch.tensor([[b - GAP / 2, b + GAP / 2] for b in boundaries], dtype=torch.float64)
    colors, _ = images_over_time(images, rays, times.flatten())
    largest = max(_change(before, after) for before, after in zip(colors[::2], colors[1::2]))
    return Finding("no popping", largest, most, largest <= most, "change across a boundary in time, at most")


@torch.no_grad()
def check_colour_along_tracks(renderer: Renderer, motion: MotionModel, rays: Rays, *, most: float = LEVEL) -> Finding:
    """A point has the same colour and density wherever it goes.

    What the rays show at t = 0 is followed by the model's own motion; the field is evaluated along the tracks, from the
    first viewing direction. A ray's point is its heaviest sample, which is inside the surface also at silhouettes and
    in fog. Points whose motion is not found (canonical residual above 1e-3) do not count, but half of them must be
    found at all times. Fields whose colour or density changes beyond the deformation fail.
    """
    rays = hitting_rays(renderer, rays)
    rays = replace(rays, times=torch.zeros_like(rays.times))
    rendering = renderer(rays)
    opaque = rendering.opacity > 0.5
    if not bool(opaque.any()):
        return Finding("colour along tracks", None, most, None, "no ray shows a surface at t = 0")
    positions, directions = _heaviest(rendering, rays)[opaque], rays.directions[opaque]
    times = torch.linspace(0, 1, NUM_TIMES).to(positions)
    tracks = follow(motion, positions, 0.0, times)
    found = (tracks.residuals < 1e-3).all(0)
    share = float(found.double().mean())
    if share < 0.5:
        return Finding("colour along tracks", share, 0.5, False, "share of points whose motion is found, at least")
    before = renderer.field(positions, directions, torch.zeros_like(positions[:, 0]))
    change = 0.0
    for places, time in zip(tracks.positions, times):
        after = renderer.field(places, directions, time.expand(len(places)))
        # Density counts as what it hides within a hundredth of a unit, whatever its size.
        hides = (torch.exp(-0.01 * after.density) - torch.exp(-0.01 * before.density)).abs()
        change = max(change, float((after.rgb - before.rgb).abs().mean(-1)[found].mean() + hides[found].mean()))
    return Finding("colour along tracks", change, most, change <= most, "change of colour and opacity, at most")


def check_closing(images: Images, rays: Rays, truth: Images) -> Finding:
    """Periodic motion closes: the last frame differs from the first by less than their errors explain.

        |I(1) - I(0)| / (|I(0) - T(0)| + |I(1) - T(1)|),    T the true image, the same at both ends

    It is 0 for a model that closes, however blurred, and 1 for one that is right at one end and elsewhere at the other.
    For errors that are normally distributed, equally large and correlated by r it is sqrt((1 - r) / 2): 0.71 for ends
    with nothing in common. The bound 0.85 lies between that and 1. Exact models (both errors below a tenth of an 8-bit
    level) pass; scenes that do not close are not measured.
    """
    most, meaning = 0.85, "change from end to end, as a share of both errors, at most"
    rays, ends = hitting_rays(truth, rays), torch.tensor([0.0, 1.0], dtype=torch.float64)
    (first, last), (true_first, true_last) = (images_over_time(of, rays, ends)[0] for of in (images, truth))
    if _change(true_first, true_last) > 0.1 * LEVEL:
        return Finding("periodic motion", None, most, None, "the scene is not periodic")
    errors = _change(true_first, first) + _change(true_last, last)
    share = _change(first, last) / errors if errors > 0.2 * LEVEL else 0.0
    return Finding("periodic motion", share, most, share <= most, meaning)


def check_unseen_times(images: Images, truth: Images, rays: Rays, train_times: Sequence[float]) -> Finding:
    """Times between training times are no worse than training times by more than a factor of 1.5, which is 3.5 dB.

    Both are of the same camera, so that only time tells them apart; errors are root mean squares against `truth`, with
    one 8-bit level added to that of training times (nothing is exact below what images hold). A model that stands still
    between training times has no bound.
    """
    rays = hitting_rays(truth, rays)
    known = torch.tensor(sorted(train_times), dtype=torch.float64)
    errors = []
    for times in (known, 0.5 * (known[1:] + known[:-1])):
        difference = images_over_time(images, rays, times)[0] - images_over_time(truth, rays, times)[0]
        errors.append(float(difference.square().mean().sqrt()))
    ratio = errors[1] / (errors[0] + LEVEL)
    return Finding("unseen times", ratio, 1.5, ratio <= 1.5, "error between training times, a multiple, at most")


def _heaviest(rendering: Rendering, rays: Rays) -> Tensor:
    """Where each ray's sample of most weight is, (R, 3); rays without samples get their origin."""
    samples, weights = rendering.samples, rendering.weights
    assert samples is not None
    assert weights is not None
    distances = samples.distances
    if samples.ray_indices is None:
        far = distances.gather(1, weights.argmax(-1, keepdim=True))[:, 0]
    else:
        most = weights.new_zeros(len(rays)).scatter_reduce(0, samples.ray_indices, weights, "amax")
        chosen = weights == most[samples.ray_indices]
        far = distances.new_zeros(len(rays)).scatter_reduce(0, samples.ray_indices[chosen], distances[chosen], "amax")
    return rays.origins + far[:, None] * rays.directions


def _change(first: Tensor, second: Tensor) -> float:
    return float((second - first).abs().mean())
