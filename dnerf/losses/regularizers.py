"""Terms about the field, not the image: unseen space, floaters, surfaces, roughness of volumes and embeddings."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive, check_whole
from dnerf.core.compositing import Rendering, sum_along_rays, sums_before
from dnerf.core.schedules import Schedule
from dnerf.deformations import unwrapped
from dnerf.fields.base import HasRoughness, RadianceField, SignedDistance, surface_of
from dnerf.fields.normals import differences
from dnerf.losses.base import Batch, Loss
from dnerf.losses.deformation import deformed, saturated, spread_numbers
from dnerf.nn.encodings import TimeEncoding
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import OccupancyAware

VISIBLE_WEIGHT = 1e-3  # share in an image from which a sample counts as seen
# By dimension d, the root of x^(d + 1) = x + 1, whose powers make Kronecker's sequence (Roberts 2018).
ROOTS = {3: 1.2207440846057596, 5: 1.1347241384015194}


class PlacesLoss(Loss):
    """A term at places that are spread evenly over many steps, others at every call."""

    def __init__(self, weight: float | Schedule, num_points: int, *, dimensions: int, every: int) -> None:
        super().__init__(weight, every=every)
        check_whole("num_points", num_points)
        self.num_points = num_points
        self.num_calls = nn.Buffer(torch.zeros((), dtype=torch.int64))
        powers = torch.arange(1, dimensions + 1, dtype=torch.float64)
        self.generators = nn.Buffer(ROOTS[dimensions] ** -powers, persistent=False)

    def next_places(self, like: Tensor) -> Tensor:
        """Points (num_points, dimensions) of the unit cube, with another tensor's device and dtype."""
        self.to(like.device)
        self.num_calls.add_(1)
        number = self.num_calls * self.num_points + torch.arange(self.num_points, device=like.device)
        return (number[:, None] * self.generators % 1).to(like.dtype)


class UnseenSpaceLoss(PlacesLoss):
    """Opacity in canonical space that no ray sees, at random places in occupied cells.

    A field invents floaters where no training ray reaches (below the ground, inside bodies), and views from elsewhere
    show it. What rays see is left alone: a cell of canonical space in which a sample had a share in an image within
    the last `memory_samples` samples costs nothing. Inside opaque bodies there is no gradient,
    `1 - exp(-density length)` is flat there; none reaches the deformation.

    Source: a sparsity prior as of Plenoxels (arXiv 2112.05131) eq. 5, restricted to what is unseen, with NeRF's opacity
    (eq. 3) for their Cauchy logarithm.

    Args:
        box: (2, 3) corners of the canonical space that is kept account of, in world units; the sampler's if None.
        weight: factor of the mean opacity.
        num_points: places of each step.
        every: steps between its turns, see `Loss`.
        length: of the intervals, in world units.
        resolution: cells along each side of the box.
        memory_samples: of the batches it is called with, after which a cell that had no share in an image counts as
            unseen. (As many calls would mean more with larger batches.)

    Raises:
        ValueError: for numbers that are not positive, or a negative weight.
    """

    def __init__(
        self, box: Sequence[Sequence[float]] | None = None, weight: float | Schedule = 1e-2, num_points: int = 1024, *,
        every: int = 4, length: float = 0.02, resolution: int = 64, memory_samples: int = 1 << 20,
    ) -> None:  # fmt: skip
        super().__init__(weight, num_points, dimensions=5, every=every)
        for name, value in (("length", length), ("resolution", resolution), ("memory_samples", memory_samples)):
            check_positive(name, value)
        self.length = length
        self.memory_samples = memory_samples
        self.takes_box = box is None
        self.box = nn.Buffer(torch.zeros(2, 3) if box is None else as_box(box), persistent=False)
        self.num_samples = nn.Buffer(torch.zeros((), dtype=torch.int64))
        self.last_seen = nn.Buffer(torch.full((resolution,) * 3, -memory_samples - 1, dtype=torch.int64))

    def check(self, model: Renderer) -> None:
        """Needs a deformed field of density, and a sampler that knows occupied cells, whose box it may take."""
        if surface_of(deformed(model, self).canonical):
            raise ValueError("UnseenSpaceLoss needs a density field: a signed distance is full where no ray sees it")
        if not isinstance(model.sampler, OccupancyAware):
            raise ValueError(f"UnseenSpaceLoss needs an occupancy-aware sampler, got {type(model.sampler).__name__}")
        if self.takes_box:
            self.box = nn.Buffer(model.sampler.occupied_cells(None).box.clone(), persistent=False)

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """Mean opacity; other places at every call, evenly spread over many of them."""
        field, sampler = deformed(model, self), model.sampler
        assert isinstance(sampler, OccupancyAware)
        assert rendering.output is not None
        assert rendering.weights is not None
        unit = self.next_places(rendering.rgb)
        self.num_samples.add_(rendering.weights.numel())
        # Nothing here waits for a device: which samples are seen, and how many, is known there only.
        seen = torch.where(rendering.weights > VISIBLE_WEIGHT, self.num_samples, torch.iinfo(torch.int64).min)
        cells = self._cells(rendering.output.extras["canonical_positions"].detach())
        self.last_seen.view(-1).scatter_reduce_(0, cells.reshape(-1), seen.reshape(-1), "amax")
        places = sampler.occupied_positions(unit.clamp(max=1 - torch.finfo(unit.dtype).eps))
        with torch.no_grad(), model.autocast(seen.device):
            canonical = unwrapped(field.deformation)(*places)  # these points lie on no rays
        is_unseen = self.num_samples - self.last_seen.view(-1)[self._cells(canonical)] > self.memory_samples
        with model.autocast(seen.device):
            density = field.canonical.density(canonical, places[1])
        return (is_unseen * -torch.expm1(-self.length * density)).mean()

    def _cells(self, positions: Tensor) -> Tensor:
        """Numbers (N,) of the cells of positions (N, 3); outside the box, of the nearest."""
        size = self.last_seen.shape[0]
        unit = (positions - self.box[0]) / (self.box[1] - self.box[0])
        x, y, z = (unit * size).long().clamp(0, size - 1).unbind(-1)
        return (x * size + y) * size + z


class DistortionLoss(Loss):
    """Spread of the weights along each ray: one surface costs least, floaters in front of it cost more.

    `o (sum_ij v_i v_j |m_i - m_j| + sum_i v_i^2 l_i / 3)`, the mean over rays, for shares v = w / o of samples at
    distances m, lengths l of their intervals, weights w and the opacity o = sum_i w_i, which gets no gradient.

    Source: mip-NeRF 360 (arXiv 2111.12077) eq. 15, with distances in world units. Deviation: there all of a ray's light
    ends in samples. Here it may end behind them, where nothing costs; so the price is of the spread, not of the light.
    """

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """The mean over rays; pairs are summed in time proportional to the samples."""
        assert rendering.samples is not None
        assert rendering.weights is not None
        samples, weights = rendering.samples, rendering.weights.double()
        moments = weights * samples.distances
        pairs = 2 * (moments * sums_before(weights, samples) - weights * sums_before(moments, samples))
        spread = sum_along_rays(pairs + weights.square() * samples.lengths / 3, samples)
        opacity = sum_along_rays(weights, samples)
        spread = spread / opacity.clamp(min=VISIBLE_WEIGHT).square() * opacity.detach()
        return rendering.mean(spread).to(rendering.rgb.dtype)


class SmoothnessLoss(Loss):
    """Roughness of what a field keeps on lattices (volumes, planes, voxels): neighbours are alike, in space and time.

    Squared differences of neighbours in space and second differences in time, means over each table: what moves evenly
    costs nothing in time, so that what one image leaves open is as in those before and after.

    Source: K-Planes (arXiv 2301.10241) section 3.2, total variation in space and smoothness in time.

    Args:
        weight, every: see `Loss`.
        time_weight: factor of the differences in time to those in space.

    Raises:
        ValueError: for a negative weight.
    """

    def __init__(self, weight: float | Schedule = 1e-2, *, time_weight: float = 1.0, every: int = 4) -> None:
        super().__init__(weight, every=every)
        check_positive("time_weight", time_weight, allow_zero=True)
        self.time_weight = time_weight
        self.num_calls = nn.Buffer(torch.zeros((), dtype=torch.int64))

    def check(self, model: Renderer) -> None:
        """Needs a part with lattices, see `HasRoughness`."""
        if not self._parts(model):
            raise ValueError("SmoothnessLoss needs a field with a part of `HasRoughness`, this one has none")

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """Roughness in space, plus that in time times its factor."""
        total = rendering.rgb.new_zeros(())
        for part in self._parts(model):
            in_space, in_time = part.roughness(self.num_calls)
            total = total + in_space + self.time_weight * in_time
        self.num_calls.add_(1)  # a tensor: graphs that replay steps go on counting
        return total

    def _parts(self, model: Renderer) -> list[HasRoughness]:
        return [part for part in model.field.modules() if isinstance(part, HasRoughness)]


class TimeEmbeddingLoss(Loss):
    """Roughness of learnt time embeddings, see `TimeEncoding`: squared differences of neighbours.

    Embeddings that lie between two frames learn nothing from images; with this they are between their neighbours, and
    after the last frame they are as the last one that was seen. Each time is seen by few cameras, often by one, and
    in a long training motion may be bent to that one. So the weight grows in proportion to the rays, from a number of
    them for each embedding on.

    Args:
        weight, every: see `Loss`.
        rays_per_embedding: of the batches it is called with, for each embedding in use, from which on the weight grows;
            None for a weight that stays.

    Raises:
        ValueError: for a negative weight, or a number of rays that is not positive.
    """

    def __init__(
        self, weight: float | Schedule = 1e-3, *, rays_per_embedding: int | None = 5_000, every: int = 4
    ) -> None:
        super().__init__(weight, every=every)
        check_positive("rays_per_embedding", 1 if rays_per_embedding is None else rays_per_embedding)
        self.rays_per_embedding = rays_per_embedding
        self.num_rays = nn.Buffer(torch.zeros((), dtype=torch.int64))

    def check(self, model: Renderer) -> None:
        """Needs learnt time embeddings."""
        if not self._parts(model):
            raise ValueError("TimeEmbeddingLoss needs learnt time embeddings, this model has none")

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """Mean squared differences; of the rendering only the number of rays matters."""
        total = rendering.rgb.new_zeros(())
        self.to(rendering.rgb.device)
        self.num_rays.add_(len(rendering.rgb))  # a tensor, as above
        for part in self._parts(model):
            each = self.rays_per_embedding
            growth = 1.0 if each is None else (self.num_rays / (each * part.num_used)).clamp(min=1)
            total = total + growth * part.roughness()
        return total

    def _parts(self, model: Renderer) -> list[TimeEncoding]:
        return [p for p in model.field.modules() if isinstance(p, TimeEncoding) and p.embeddings is not None]


def canonical_surface(field: RadianceField) -> SignedDistance | None:
    """What has a surface in canonical space, behind all deformations; None if nothing has."""
    surfaces = [surface for surface in map(surface_of, field.modules()) if surface is not None]
    return surfaces[-1] if surfaces else None  # parts come after what they are part of


class EikonalLoss(PlacesLoss):
    """The gradient of a signed distance has length one: the mean of `(|grad d| - 1)^2`, in canonical space.

    At some of a batch's own samples, and at as many places spread over a box. The gradient is that of central
    differences over a cell of the finest open level of the grid: they reach into neighbouring cells, and need no second
    derivatives. At the samples surfaces should hardly bend within a cell, either: features that are linear in each cell
    leave them rough by some degrees, which images hardly tell. That price is robust, since edges are folds.

    Source: IGR (arXiv 2002.10099) eq. 2; differences that follow the levels, and a price on second ones, from
    Neuralangelo (arXiv 2306.03092) sections 3.2 and 3.3. Deviation: theirs are not squared, and per unit of length.

    Args:
        box: (2, 3) corners of the space in which places lie, in world units.
        weight, every: see `Loss`.
        num_points: samples of each batch, and as many places in the box.
        bending: price of bends beside that of lengths: of the squared change of slopes over a cell.
        saturation: squared change that no bend counts for more than, see `saturated`.

    Raises:
        ValueError: for a box that is none, or numbers out of range.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], weight: float | Schedule = 3e-3, num_points: int = 256, *,
        bending: float = 1.0, saturation: float = 0.3, every: int = 1,
    ) -> None:  # fmt: skip
        super().__init__(weight, num_points, dimensions=3, every=every)
        check_positive("bending", bending, allow_zero=True)
        check_positive("saturation", saturation)
        self.bending, self.saturation = bending, saturation
        self.box = nn.Buffer(as_box(box), persistent=False)

    def check(self, model: Renderer) -> None:
        """Needs a field with a signed distance."""
        if canonical_surface(model.field) is None:
            raise ValueError(f"EikonalLoss needs a field with a signed distance, got {type(model.field).__name__}")

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """Mean squared deviation from one, and price of bends; other places at every call."""
        surface = canonical_surface(model.field)
        assert surface is not None
        assert rendering.output is not None
        unit = self.next_places(rendering.rgb)
        places = [torch.lerp(self.box[0].to(unit.dtype), self.box[1].to(unit.dtype), unit)]
        times = [unit[:, 0] * 0]
        extras = rendering.output.extras
        if "canonical_positions" in extras:
            chosen = spread_numbers(extras["times"].shape, self.num_points, unit.device)
            places.append(extras["canonical_positions"].detach().reshape(-1, 3)[chosen])
            times.append(extras["times"].reshape(-1)[chosen])
        gradients, bends = differences(surface, torch.cat(places), torch.cat(times), surface.detail)
        lengths = (gradients.norm(dim=-1) - 1).square().mean()
        own = saturated(bends[self.num_points :], self.saturation)
        return lengths + self.bending * own.mean() if own.numel() else lengths
