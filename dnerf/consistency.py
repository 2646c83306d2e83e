"""Checks that a moving scene is consistent over time; any renderer can be put through them.

Each check measures one number and compares it with a stated bound. Pictures are compared on the rays that see matter
at some time; "change" is the mean absolute difference of their colours.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.checks import check_positive
from dnerf.compositing import Rendering
from dnerf.deformations import Deformation
from dnerf.motion import follow, motion_model
from dnerf.rays import Rays
from dnerf.renderer import Renderer

LEVEL = 1 / 255
"""One step of an 8-bit picture."""

SHARP, SMOOTH = 0.25, 0.75
"""Least orders of continuity: halfway from a jump (0) to a sharp edge (1/2), and from there to a smooth field (1)."""

SLOPE_OVER = 8


@dataclass(frozen=True)
class Finding:
    """What one check found.

    Args:
        check: its name.
        value: what was measured.
        bound: what it is compared with.
        passed: whether it keeps the bound.
        meaning: in words, with the unit.
    """

    check: str
    value: float
    bound: float
    passed: bool
    meaning: str

    def __str__(self) -> str:
        verdict = "passed" if self.passed else "FAILED"
        return f"{self.check}: {verdict} ({self.meaning}: {self.value:.3g}, bound {self.bound:.3g})"


@torch.no_grad()
def pictures_over_time(renderer: Renderer, rays: Rays, times: Tensor, *, chunk: int = 16384) -> tuple[Tensor, Tensor]:
    """Colours (T, R, 3) and opacities (T, R) of R rays at T times, in evaluation mode; their own times are unused."""
    modes = [(module, module.training) for module in renderer.modules()]
    renderer.eval()
    colors, opacities = [], []
    per_chunk = max(1, chunk // len(rays))
    try:
        for some in times.to(rays.times).split(per_chunk):
            count = len(some)
            repeated = Rays(
                origins=rays.origins.repeat(count, 1),
                directions=rays.directions.repeat(count, 1),
                times=some.repeat_interleave(len(rays)),
                near=rays.near.repeat(count),
                far=rays.far.repeat(count),
            )
            rendering = renderer(repeated)
            colors.append(rendering.rgb.reshape(count, len(rays), 3))
            opacities.append(rendering.opacity.reshape(count, len(rays)))
    finally:
        for module, mode in modes:
            module.training = mode
    return torch.cat(colors), torch.cat(opacities)


def seeing_rays(renderer: Renderer, rays: Rays, num_times: int = 9) -> Rays:
    """The rays that see matter at one of some times.

    Raises:
        ValueError: if none does.
    """
    _, opacity = pictures_over_time(renderer, rays, torch.linspace(0, 1, num_times))
    seeing = (opacity > 0.05).any(0)
    if not bool(seeing.any()):
        raise ValueError("rays must see matter at some time, none does")
    return rays[seeing]


def check_continuity(
    renderer: Renderer, rays: Rays, *, num_times: int = 33, num_halvings: int = 12, least_order: float = SMOOTH
) -> Finding:
    """Frames at t and t + h converge to each other at the expected order as h goes to 0.

    The four intervals of time over which the picture changes most are halved again and again, keeping the halves with
    the largest change: where the picture jumps, the change stays; where it is Lipschitz, it halves. The order is the
    least-squares slope of log2 change over the last eight halvings.

    A jump has order 0. Bodies with a sharp edge have order 1/2: the chord of a ray through a ball grows with the root
    of how deep it dips, so that the ray that has just met it changes fastest. Smooth fields have order 1. `SHARP` and
    `SMOOTH` lie halfway between neighbours. Where in its interval a ray meets an edge is as good as random, which
    scatters each log2 change by 0.5 / ln 2 = 0.72 at most and the slope of nine by 0.72 / sqrt(60) = 0.09, so that an
    edge is more than two standard deviations from either bound; jumps and smooth fields scatter far less.

    Args:
        renderer: the model.
        rays: R rays; in double precision, steps of time may be as small as one likes.
        num_times: even steps among which the search begins.
        num_halvings: at least 8; in single precision, the last step should stay above 1e-5.
        least_order: that passes.

    Raises:
        ValueError: for fewer than 8 halvings.
    """
    if num_halvings < SLOPE_OVER:
        raise ValueError(f"num_halvings must be at least {SLOPE_OVER}, got {num_halvings}")
    seen = seeing_rays(renderer, rays)
    times = torch.linspace(0, 1, num_times, dtype=torch.float64)
    pictures, _ = pictures_over_time(renderer, seen, times)
    intervals = [
        (_change(pictures[i], pictures[i + 1]), float(times[i]), float(times[i + 1]), pictures[i], pictures[i + 1])
        for i in range(num_times - 1)
    ]
    worst = []
    for _ in range(num_halvings + 1):
        intervals = sorted(intervals, key=lambda interval: -interval[0])[:4]
        worst.append(intervals[0][0])
        middles = [0.5 * (start + end) for _, start, end, _, _ in intervals]
        between, _ = pictures_over_time(renderer, seen, torch.tensor(middles, dtype=torch.float64))
        halves = []
        for (_, start, end, first, last), middle, picture in zip(intervals, middles, between):
            halves.append((_change(first, picture), start, middle, first, picture))
            halves.append((_change(picture, last), middle, end, picture, last))
        intervals = halves
    if worst[0] < 1e-4 * LEVEL:
        return Finding("time continuity", math.inf, least_order, True, "order in h; nothing changes")
    # A picture that no longer changes at all is below rounding: nothing jumps.
    logarithms = [math.log2(max(change, 1e-30)) for change in worst[-SLOPE_OVER - 1 :]]
    centered = [i - SLOPE_OVER / 2 for i in range(SLOPE_OVER + 1)]
    order = -sum(c * y for c, y in zip(centered, logarithms)) / sum(c * c for c in centered)
    return Finding("time continuity", order, least_order, order >= least_order, "order in h of the change")


def check_popping(
    renderer: Renderer, rays: Rays, boundaries: Sequence[float], *, most: float = 0.5 * LEVEL, gap: float = 1e-5
) -> Finding:
    """The picture does not jump where slabs or cells of time meet.

    Args:
        renderer: the model.
        rays: R rays.
        boundaries: times in (0, 1) at which something in the model is divided.
        most: largest change from right before to right behind a boundary; half an 8-bit level is what rounding hides.
        gap: between the two, in units of time; smooth motion changes nothing visible within it.
    """
    seen = seeing_rays(renderer, rays)
    moments = torch.tensor([[b - gap / 2, b + gap / 2] for b in boundaries], dtype=torch.float64)
    pictures, _ = pictures_over_time(renderer, seen, moments.flatten())
    changes = [_change(before, after) for before, after in zip(pictures[::2], pictures[1::2])]
    return Finding("no popping", max(changes), most, max(changes) <= most, "change across a boundary in time")


def check_canonical_identity(deformation: Deformation, canonical_time: float, box: Tensor) -> Finding:
    """At its canonical time a deformation leaves every point exactly where it is."""
    generator = torch.Generator(box.device).manual_seed(0)
    unit = torch.rand(4096, 3, generator=generator, device=box.device)
    positions = torch.lerp(box[0], box[1], unit)
    with torch.no_grad():
        moved = deformation(positions, torch.full_like(unit[:, 0], canonical_time))
    distance = float((moved - positions).norm(dim=-1).max())
    return Finding("canonical identity", distance, 0.0, distance == 0, "largest offset at the canonical time, units")


@torch.no_grad()
def check_colour_along_tracks(
    renderer: Renderer, rays: Rays, *, start: float = 0.0, num_times: int = 9, most: float = LEVEL, least: float = 0.5
) -> Finding:
    """The same matter has the same colour and density wherever it goes.

    What the rays see at the start is followed by the model's own motion; the field is asked along the tracks, from the
    direction it was first seen from. A ray's point is its heaviest sample, which is inside matter also at silhouettes
    and in fog. Points whose motion is not found (canonical residual above 1e-3) do not count, but at least a share
    `least` of them must be found at all times. Only for fields whose colour does not depend on the time beyond the
    deformation (no shading that changes).

    Raises:
        ValueError: if no ray sees matter at the start.
    """
    seen = seeing_rays(renderer, rays)
    at_start = Rays(seen.origins, seen.directions, torch.full_like(seen.times, start), seen.near, seen.far)
    renderer.eval()
    rendering = renderer(at_start)
    opaque = rendering.opacity > 0.5
    if not bool(opaque.any()):
        raise ValueError(f"rays must see matter at the start, t = {start}; none does")
    positions, directions = _heaviest(rendering, at_start)[opaque], seen.directions[opaque]
    times = torch.linspace(0, 1, num_times).to(positions)
    tracks = follow(motion_model(renderer), positions, start, times)
    found = (tracks.residuals < 1e-3).all(0)
    share = float(found.double().mean())
    if share < least:
        return Finding("colour along tracks", share, least, False, "share of points whose motion is found")
    before = renderer.field(positions, directions, torch.full_like(positions[:, 0], start))
    change = 0.0
    for places, time in zip(tracks.positions, times):
        after = renderer.field(places, directions, time.expand(len(places)))
        # Seen through a hundredth of a unit, so that a density of any size counts as what it hides.
        hides = (torch.exp(-0.01 * after.density) - torch.exp(-0.01 * before.density)).abs()
        change = max(change, float((after.rgb - before.rgb).abs().mean(-1)[found].mean() + hides[found].mean()))
    return Finding("colour along tracks", change, most, change <= most, "change of colour and of what is hidden")


def check_static(
    renderer: Renderer, rays: Rays, *, most: float, truth: Renderer | None = None, num_times: int = 17
) -> Finding:
    """A static scene renders alike at all times: largest change from the first frame.

    With the truth, the change is a share of both frames' errors as in `check_closing`, for models that are not exact.
    """
    seen = seeing_rays(renderer if truth is None else truth, rays)
    times = torch.linspace(0, 1, num_times, dtype=torch.float64)
    pictures, _ = pictures_over_time(renderer, seen, times)
    if truth is None:
        change = max(_change(pictures[0], picture) for picture in pictures)
        return Finding("static scene", change, most, change <= most, "change over time")
    true, _ = pictures_over_time(truth, seen, times)
    share = max(_share_of_errors(pictures[[0, i]], true[[0, i]]) for i in range(1, num_times))
    return Finding("static scene", share, most, share <= most, "change over time, as a share of both errors")


def check_closing(renderer: Renderer, rays: Rays, truth: Renderer, *, most: float = 0.85) -> Finding:
    """Periodic motion closes: the last frame differs from the first by less than their errors explain.

        |I(1) - I(0)| / (|I(0) - T| + |I(1) - T|),    T the true picture at both ends

    It is 0 for a model that closes, however blurred, and at most 1 by the triangle inequality. It is 1 for one that is
    right at one end and elsewhere at the other. For errors that are normally distributed, equally large and correlated
    by r it is sqrt((1 - r) / 2): 0.71 for ends with nothing in common. The default bound lies between that and 1.
    Exact models (both errors below a tenth of an 8-bit level) pass.
    """
    seen = seeing_rays(truth, rays)
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    share = _share_of_errors(pictures_over_time(renderer, seen, ends)[0], pictures_over_time(truth, seen, ends)[0])
    return Finding("periodic motion", share, most, share <= most, "change from end to end, as a share of both errors")


def _share_of_errors(pictures: Tensor, truths: Tensor) -> float:
    """The change between two pictures as a share of the sum of their errors."""
    errors = _change(truths[0], pictures[0]) + _change(truths[1], pictures[1])
    return _change(pictures[0], pictures[1]) / errors if errors > 0.2 * LEVEL else 0.0


def check_unseen_times(
    renderer: Renderer, truth: Renderer, rays: Rays, train_times: Sequence[float], *, factor: float = 1.5
) -> Finding:
    """Times between training times are no worse than training times by more than a factor.

    Both are seen from the same camera, so that only time tells them apart; errors are root mean squares against
    `truth`, with one 8-bit level added to the seen one (nothing is exact below what the pictures hold). The factor
    1.5 is 3.5 dB; a model that stands still between training times has no bound.
    """
    check_positive("factor", factor)
    seen = seeing_rays(truth, rays)
    known = torch.tensor(sorted(train_times), dtype=torch.float64)
    between = 0.5 * (known[1:] + known[:-1])
    errors = []
    for times in (known, between):
        difference = pictures_over_time(renderer, seen, times)[0] - pictures_over_time(truth, seen, times)[0]
        errors.append(float(difference.square().mean().sqrt()))
    ratio = errors[1] / (errors[0] + LEVEL)
    return Finding("unseen times", ratio, factor, ratio <= factor, "error between training times, as a multiple")


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
