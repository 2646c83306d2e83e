"""Surfaces found by sphere tracing: one opaque sample for each ray that meets one."""

import logging
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive, check_whole
from dnerf.core.geometry import clip_to_box
from dnerf.core.rays import Rays, Samples
from dnerf.fields.base import PAD_TO, RadianceField, SignedDistance, surface_of
from dnerf.fields.normals import differences
from dnerf.samplers.base import Sampler

logger = logging.getLogger(__name__)

PROBE_STEP = 1e-3  # world units, of differences of the distance
MOST_BISECTIONS = 30  # more do not change float32

Distances = Callable[[Tensor, Tensor], Tensor]
"""Of rays with numbers (n,) int64 at (n,) along them."""


class SphereTracingSampler(Sampler):
    """Steps along rays as far as the signed distance says that nothing is, until it is zero.

    A step is the distance divided by how steep it may be in the world: its gradient, to which a deformation adds the
    factor of its transposed Jacobian, is measured at random places of the box at the rays' times, and the longest,
    times `safety`, is the bound. A step that crosses a surface is seen by its sign and bisected; one through a thin
    body is not.

    Samples are opaque, see `Samples`: the image is that of the volume as its sharpness grows. Rays that miss have none.
    No gradient reaches the distance: train with another sampler.

    Source: Hart 1996, "Sphere tracing", theorem 1 for the bound under a deformation.

    Args:
        box: (2, 3) corners of the space that is looked into, in world units.
        num_steps: most of each ray; one that has not arrived by then counts as missing.
        tolerance: distance, in world units, that counts as none.
        safety: factor on the largest steepness found, since places in between may be steeper, >= 1.
        num_probes: places at which it is looked for.

    Raises:
        ValueError: for numbers out of range; when called, for a field without a signed distance.
        FloatingPointError: when called, for distances that are NaN.
    """

    def __init__(
        self, box: Sequence[Sequence[float]] | Tensor, *, num_steps: int = 256, tolerance: float = 1e-4,
        safety: float = 1.25, num_probes: int = 1024,
    ) -> None:  # fmt: skip
        super().__init__()
        check_whole("num_steps", num_steps)
        check_whole("num_probes", num_probes)
        check_positive("tolerance", tolerance)
        if not safety >= 1:
            raise ValueError(f"safety must be at least 1, got {safety}")
        self.box = nn.Buffer(as_box(box), persistent=False)
        self.num_steps, self.tolerance = num_steps, tolerance
        self.safety, self.num_probes = safety, num_probes
        self.has_warned = False

    @torch.no_grad()
    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        """Packed samples, one of every ray that meets a surface."""
        surface = surface_of(field)
        if surface is None:
            raise ValueError(f"sphere tracing needs a field with a signed distance, got {type(field).__name__}")
        with torch.autocast(rays.near.device.type, enabled=False):
            numbers, starts = self._hits(rays, surface)
        order = numbers.argsort()
        numbers, starts = numbers[order], starts[order]
        ends = torch.minimum(starts + self.tolerance, rays.far[numbers])
        return Samples(starts, ends, len(rays), ray_indices=numbers, points=starts, is_opaque=True)

    def _hits(self, rays: Rays, surface: SignedDistance) -> tuple[Tensor, Tensor]:
        """Numbers (H,) of the rays that meet a surface, and where (H,)."""
        near, far = clip_to_box(rays.origins, rays.directions, rays.near, rays.far, self.box.to(rays.near.dtype))
        numbers = (far > near).nonzero()[:, 0]
        t, before = near[numbers], near[numbers]
        found = [(numbers[:0], t[:0])]
        if not len(numbers):
            return found[0]
        probed, steepness = self._probe(surface, rays)

        def distances(numbers: Tensor, t: Tensor) -> Tensor:
            padding = -len(t) % PAD_TO  # matrix libraries compile code for every new number of rows
            numbers, t = (torch.cat([x, x[-1:].expand(padding)]) for x in (numbers, t))
            positions, _, times = rays.places(numbers, t)
            return _numbers(surface.distance(positions, times)[: len(t) - padding])

        for _ in range(self.num_steps):
            if not len(numbers):
                break
            distance = distances(numbers, t)
            is_inside, is_there = distance <= 0, distance < self.tolerance
            if bool(is_there.any()):
                crossed = is_inside.nonzero()[:, 0]
                t[crossed] = self._bisected(distances, numbers[crossed], before[crossed], t[crossed])
                found.append((numbers[is_there], t[is_there]))
            ends = far[numbers]
            before, t = t, torch.minimum(t + (distance / steepness).clamp(min=self.tolerance), ends)
            goes_on = ~is_there & (before < ends)
            numbers, before, t = numbers[goes_on], before[goes_on], t[goes_on]
        if len(found) == 1 and not self.has_warned and bool((probed > 0).all()):
            self.has_warned = True
            logger.warning("no ray meets a surface: the signed distance in the box is above %.3g", float(probed.min()))
        first, second = zip(*found)
        return torch.cat(first), torch.cat(second)

    def _bisected(self, distances: Distances, numbers: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """Where (H,) the distance is zero between a place outside and one inside, to the tolerance."""
        for _ in range(MOST_BISECTIONS):
            if not len(low) or bool((high - low).max() <= self.tolerance):
                break
            middle = 0.5 * (low + high)
            is_outside = distances(numbers, middle) > 0
            low, high = torch.where(is_outside, middle, low), torch.where(is_outside, high, middle)
        return low

    def _probe(self, surface: SignedDistance, rays: Rays) -> tuple[Tensor, Tensor]:
        """Distances (P,) at probes in the box, and a bound () on how steep they are, at least 1."""
        generator = torch.Generator(rays.near.device).manual_seed(0)
        unit = torch.rand(self.num_probes, 4, generator=generator, device=rays.near.device, dtype=rays.near.dtype)
        low, high = self.box.to(unit.dtype)
        places = torch.lerp(low, high, unit[:, :3])
        times = rays.times[(unit[:, 3] * len(rays)).long().clamp(max=len(rays) - 1)]
        steepest = _numbers(differences(surface, places, times, PROBE_STEP)[0]).norm(dim=-1).max()
        return surface.distance(places, times), (self.safety * steepest).clamp(min=1)


def _numbers(values: Tensor) -> Tensor:
    """The values; FloatingPointError for NaN, of which no comparison holds: rays would pass for such that miss."""
    if bool(values.isnan().any()):
        raise FloatingPointError("the signed distance is NaN")
    return values
