"""Training losses: each looks at a rendering and its target and returns one number."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.checks import as_box, check_choice, check_positive
from dnerf.compositing import Rendering
from dnerf.encodings import TimeEncoding
from dnerf.fields import DeformedField, SpaceTimeVolumes
from dnerf.renderer import Renderer

SHARE_THAT_IS_SEEN = 1e-3
PLASTIC = 1.1347241384015194


class Loss(nn.Module, ABC):
    """One term of the training loss, its weight included."""

    @abstractmethod
    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        """Loss, a scalar.

        Args:
            rendering: of a batch of R rays.
            target: (R, 3) true colours on the rendering's background.
            renderer: the model, for terms about its parameters or its field.
        """

    def set_progress(self, progress: float) -> None:
        """How much of training is over, in [0, 1], before each step; for terms that change with it."""


class PhotometricLoss(Loss):
    """Mean squared or Huber error of colour, of the earlier (coarse) passes as well: NeRF eq. 6.

    Args:
        kind: "mse", or "huber" (quadratic below `delta`, linear above, scaled to agree with the mse for small errors).
        delta: where Huber turns linear, in units of colour.
        proposal_weight: weight of the coarse passes' errors.

    Raises:
        ValueError: for another kind or numbers that are not positive.
    """

    def __init__(self, kind: str = "mse", *, delta: float = 0.1, proposal_weight: float = 1.0) -> None:
        super().__init__()
        check_choice("kind", kind, ("mse", "huber"))
        check_positive("delta", delta)
        check_positive("proposal_weight", proposal_weight, allow_zero=True)
        self.kind = kind
        self.delta = delta
        self.proposal_weight = proposal_weight

    def _error(self, rendering: Rendering, target: Tensor) -> Tensor:
        if self.kind == "mse":
            errors = nn.functional.mse_loss(rendering.rgb, target, reduction="none")
        else:
            errors = 2 * nn.functional.huber_loss(rendering.rgb, target, delta=self.delta, reduction="none")
        return rendering.mean(errors.mean(-1))

    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        """Error of the picture plus the weighted errors of its proposals' pictures."""
        loss = self._error(rendering, target)
        for proposal in rendering.proposals:
            loss = loss + self.proposal_weight * self._error(proposal, target)
        return loss


class FadingLoss(Loss):
    """Another term, times a factor that falls while training goes on: 1 until `begin`, `share` from `end` on.

    In between it falls by equal ratios. For what a scene should do while it is being found, but need not do exactly.

    Args:
        loss: the term.
        begin: fraction of training, in [0, 1), until which it counts in full.
        end: fraction of training, in (begin, 1], from which on it counts `share` of that.
        share: what is left, in (0, 1].

    Raises:
        ValueError: for numbers out of range, or something else than a loss.
    """

    def __init__(self, loss: Loss, *, begin: float = 0.3, end: float = 0.7, share: float = 0.03) -> None:
        super().__init__()
        if not isinstance(loss, Loss):
            raise ValueError(f"loss must be a Loss, got {type(loss).__name__}")
        if not 0 <= begin < end <= 1:
            raise ValueError(f"begin and end must be 0 <= begin < end <= 1, got {begin} and {end}")
        if not 0 < share <= 1:
            raise ValueError(f"share must be in (0, 1], got {share}")
        self.loss = loss
        self.begin = begin
        self.end = end
        self.share = share
        self.register_buffer("factor", torch.ones(()), persistent=False)  # a tensor: graphs that replay steps read it
        self.factor: Tensor

    def set_progress(self, progress: float) -> None:
        """Set the factor to what it is when so much of training is over, `progress` in [0, 1]."""
        faded = min(max((progress - self.begin) / (self.end - self.begin), 0.0), 1.0)
        self.factor.fill_(self.share**faded)
        self.loss.set_progress(progress)

    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        """The term times the factor."""
        self.to(rendering.rgb.device)
        return self.factor * self.loss(rendering, target, renderer)


class OpacityEntropyLoss(Loss):
    """Binary entropy of each ray's opacity: rays should be clear or blocked, not hazy (for solid scenes).

    Args:
        weight: factor of the term.
    """

    def __init__(self, weight: float = 1e-3) -> None:
        super().__init__()
        check_positive("weight", weight, allow_zero=True)
        self.weight = weight

    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        """Weighted mean of -o log o - (1 - o) log(1 - o); o is kept 1e-4 from 0 and 1, so that gradients are finite."""
        opacity = rendering.opacity.clamp(1e-4, 1 - 1e-4)
        entropy = -(opacity * torch.log(opacity) + (1 - opacity) * torch.log1p(-opacity))
        return self.weight * rendering.mean(entropy)


class HiddenMatterLoss(Loss):
    """Opacity of canonical matter that no ray sees, at random places where the sampler thinks that matter may be.

    A field invents matter where no training ray reaches (below the ground, inside bodies), and views from elsewhere
    show it. What rays see is left alone: a cell of canonical space in which a sample had a share in a picture within
    the last `memory_samples` samples costs nothing. Inside opaque matter there is no gradient,
    `1 - exp(-density length)` is flat there; none reaches the deformation.

    Without effect for samplers that do not know where matter is, see `Sampler.places`.

    Source: a sparsity prior as of Plenoxels (arXiv 2112.05131) eq. 5, restricted to what is hidden, with NeRF's opacity
    (eq. 3) for their Cauchy logarithm.

    Args:
        box: (2, 3) corners of the canonical space that is kept account of, in world units.
        weight: factor of the mean opacity.
        num_points: places of each step.
        length: of the intervals, in world units.
        resolution: cells along each side of the box.
        memory_samples: of the batches it is called with, after which a cell that had no share in a picture counts as
            hidden. (As many calls would mean more with larger batches.)

    Raises:
        ValueError: for numbers that are not positive, or a negative weight; when used, for a field that is not
            deformed.
    """

    def __init__(
        self,
        box: Sequence[Sequence[float]],
        weight: float = 1e-2,
        num_points: int = 1024,
        *,
        length: float = 0.02,
        resolution: int = 64,
        memory_samples: int = 1 << 20,
    ) -> None:
        super().__init__()
        check_positive("weight", weight, allow_zero=True)
        for name, value in (
            ("num_points", num_points), ("length", length), ("resolution", resolution),
            ("memory_samples", memory_samples),
        ):  # fmt: skip
            check_positive(name, value)
        self.weight = weight
        self.num_points = num_points
        self.length = length
        self.memory_samples = memory_samples
        self.register_buffer("box", as_box(box), persistent=False)
        self.register_buffer("num_calls", torch.zeros((), dtype=torch.int64))
        self.register_buffer("num_samples", torch.zeros((), dtype=torch.int64))
        self.register_buffer("last_seen", torch.full((resolution,) * 3, -memory_samples - 1, dtype=torch.int64))
        # Kronecker's sequence in five dimensions: powers of the root of x^6 = x + 1 (Roberts 2018).
        powers = torch.arange(1, 6, dtype=torch.float64)
        self.register_buffer("generators", PLASTIC**-powers, persistent=False)
        self.box: Tensor
        self.generators: Tensor
        self.num_calls: Tensor
        self.num_samples: Tensor
        self.last_seen: Tensor

    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        """Weighted mean opacity; other places at every call, evenly spread over many of them."""
        field = renderer.field
        if not isinstance(field, DeformedField):
            raise ValueError(f"HiddenMatterLoss needs a deformed field, got {type(field).__name__}")
        assert rendering.output is not None
        assert rendering.weights is not None
        self.to(rendering.rgb.device)
        self.num_calls += 1
        self.num_samples += rendering.weights.numel()
        # Nothing here waits for a device: which samples are seen, and how many, is known there only.
        seen = torch.where(rendering.weights > SHARE_THAT_IS_SEEN, self.num_samples, torch.iinfo(torch.int64).min)
        cells = self._cells(rendering.output.extras["canonical_positions"].detach())
        self.last_seen.view(-1).scatter_reduce_(0, cells.reshape(-1), seen.reshape(-1), "amax")
        number = self.num_calls * self.num_points + torch.arange(self.num_points, device=seen.device)
        unit = (number[:, None] * self.generators % 1).to(rendering.rgb.dtype)
        places = renderer.sampler.places(unit.clamp(max=1 - torch.finfo(unit.dtype).eps))
        if places is None:
            return rendering.rgb.new_zeros(())
        with torch.no_grad(), renderer.autocast(seen.device):
            canonical = field.deformation(field.carried(*places), places[1])
        is_hidden = self.num_samples - self.last_seen.view(-1)[self._cells(canonical)] > self.memory_samples
        with renderer.autocast(seen.device):
            density = field.canonical.density(canonical, places[1])
        return self.weight * (is_hidden * -torch.expm1(-self.length * density)).mean()

    def _cells(self, positions: Tensor) -> Tensor:
        """Numbers (N,) of the cells of positions (N, 3); outside the box, of the nearest."""
        size = self.last_seen.shape[0]
        unit = (positions - self.box[0]) / (self.box[1] - self.box[0])
        x, y, z = (unit * size).long().clamp(0, size - 1).unbind(-1)
        return (x * size + y) * size + z


class SmoothVolumesLoss(Loss):
    """Roughness of space-time volumes that have joined: each moment is seen from one side, and moments are alike.

    Squared differences of neighbours in space and second differences in time, means over each table: what moves evenly
    costs nothing in time, so that what one picture leaves open is as in those before and after.

    Source: K-Planes (arXiv 2301.10241) section 3.2, total variation in space and smoothness in time.

    Args:
        space_weight: factor of the differences in space.
        time_weight: of those in time.

    Raises:
        ValueError: for a negative weight.
    """

    def __init__(self, space_weight: float = 1e-2, time_weight: float = 1e-2) -> None:
        super().__init__()
        check_positive("space_weight", space_weight, allow_zero=True)
        check_positive("time_weight", time_weight, allow_zero=True)
        self.space_weight = space_weight
        self.time_weight = time_weight

    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        """See `Loss`; only the field matters here, and one without volumes, or with such that wait, costs nothing."""
        total = rendering.rgb.new_zeros(())
        for part in renderer.field.modules():
            if isinstance(part, SpaceTimeVolumes) and part.has_joined:
                in_space, in_time = part.roughness()
                total = total + self.space_weight * in_space + self.time_weight * in_time
        return total


class SmoothKnotsLoss(Loss):
    """Roughness of what deformations learn of single moments, see `TimeEncoding`: squared differences of neighbours.

    Knots that lie between two frames learn nothing from pictures; with this they are between their neighbours, and
    after the last frame they are as the last one that was seen. Each moment is seen by few cameras, often by one, and
    in a long training motion may be bent to that one. So the weight grows in proportion to the rays, from a number of
    them for each knot on.

    Args:
        weight: factor of their mean.
        rays_per_knot: of the batches it is called with, for each knot in use, from which on the weight grows; None for
            a weight that stays.

    Raises:
        ValueError: for a negative weight, or a number of rays that is not positive.
    """

    def __init__(self, weight: float = 1e-3, *, rays_per_knot: int | None = 5_000) -> None:
        super().__init__()
        check_positive("weight", weight, allow_zero=True)
        if rays_per_knot is not None:
            check_positive("rays_per_knot", rays_per_knot)
        self.weight = weight
        self.rays_per_knot = rays_per_knot
        self.register_buffer("num_rays", torch.zeros((), dtype=torch.int64))
        self.num_rays: Tensor

    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        """See `Loss`; of the rendering only the number of rays matters, and a field without knots costs nothing."""
        total = rendering.rgb.new_zeros(())
        self.to(rendering.rgb.device)
        self.num_rays += len(rendering.rgb)  # a tensor: graphs that replay steps go on counting
        for part in renderer.field.modules():
            if isinstance(part, TimeEncoding) and part.knots is not None:
                total = total + self.weight * self._growth(part) * part.roughness()
        return total

    def _growth(self, encoding: TimeEncoding) -> Tensor | float:
        if self.rays_per_knot is None:
            return 1.0
        return (self.num_rays / (self.rays_per_knot * encoding.num_used)).clamp(min=1)
