"""The shared alpha-compositing renderer: everything that emits light along a ray goes through `composite`.

With interval lengths d_i, densities s_i and optical depths tau_i = s_i d_i (Max 1995, eq. 26; NeRF eq. 3):

    w_i = exp(-sum_{j<i} tau_j) (1 - exp(-tau_i)),    C = sum_i w_i c_i + (1 - sum_i w_i) background

The exclusive sum is a shifted one (never "inclusive minus self", which is inf - inf on opaque intervals), the
opacity of an interval is `-expm1(-tau)` (exact for thin ones), and sums run per ray in at least float32.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from dnerf.core.checks import check_shape
from dnerf.core.quadrature import OPAQUE, optical_depths, spread_weights
from dnerf.core.rays import Samples
from dnerf.kernels import packed_sum, packed_weights

FAINT = 1e-30
"""Opacity up to which depth has no gradient: quotients by numbers near the smallest float32 have infinite ones."""


@dataclass(frozen=True)
class FieldOutput:
    """What a radiance field says at some points."""

    density: Tensor  # (...,) >= 0 in 1 / world unit
    rgb: Tensor  # (..., 3) in [0, 1]
    extras: Mapping[str, Tensor] = field(default_factory=dict)  # what losses read, as "canonical_positions" (..., 3)


@dataclass(frozen=True)
class Rendering:
    """What R rays (or the pixels of an image: (H, W) instead of (R,)) show; whole images have no per-sample data."""

    rgb: Tensor  # (R, 3) light reaching the eye, background included
    opacity: Tensor  # (R,) in [0, 1], light absorbed along the ray
    depth: Tensor  # (R,) expected distance at which light is absorbed, in world units; 0 where opacity is 0
    background: Tensor | None = None  # (R, 3) what lies behind; None for black
    weights: Tensor | None = None  # share of each sample in the image, laid out like the samples
    samples: Samples | None = None  # those composited
    output: FieldOutput | None = None  # what the field said there
    proposals: "tuple[Rendering, ...]" = ()  # of the sampler's earlier passes (the coarse network's image)

    @property
    def is_placed(self) -> Tensor | None:
        """(R,) bool, the rays that found places for their samples; None for all of them. See `Samples`."""
        return None if self.samples is None else self.samples.is_placed

    def mean(self, values: Tensor) -> Tensor:
        """The mean () of values (R,) over the rays that found places: of others the image says nothing."""
        if self.is_placed is None:
            return values.mean()
        return torch.where(self.is_placed, values, 0).sum() / self.is_placed.sum().clamp(min=1)


def at_least_float32(values: Tensor) -> Tensor:
    """Half precision raised to float32."""
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values


def render_weights(optical_depth: Tensor, samples: Samples) -> Tensor:
    """Weight of each sample in the image: the transmittance before it times its own opacity.

    Args:
        optical_depth: (R, S) or (N,), density times interval length, >= 0, infinity allowed.
        samples: the samples it belongs to, dense or packed.

    Returns:
        Weights laid out like the input, each ray's sum at most 1; float32 for half-precision input.

    Raises:
        ValueError: if the layout is not that of the samples.
    """
    check_shape("optical_depth", optical_depth, samples.starts.shape)
    depth = at_least_float32(optical_depth)
    if samples.is_packed:
        return packed_weights(depth, samples.offsets)
    before = torch.cumsum(depth[:, :-1], dim=-1)
    transmittance = torch.exp(-torch.cat([torch.zeros_like(depth[:, :1]), before], dim=-1))
    return transmittance * -torch.expm1(-depth)


def sums_before(values: Tensor, samples: Samples) -> Tensor:
    """Sum of the values, (R, S) or (N,), before each sample on its ray, laid out like them."""
    if not samples.is_packed:
        return values.cumsum(-1) - values
    sums = torch.nn.functional.pad(values.cumsum(0), (1, 0))
    return sums[:-1] - samples.per_sample(sums[samples.offsets[:-1]])


def sum_along_rays(values: Tensor, samples: Samples, weights: Tensor | None = None) -> Tensor:
    """Sum each ray's samples, weighted if weights are given.

    Args:
        values: (R, S, ...) or (N, ...); float32 sums for half-precision input.
        samples: the samples they belong to.
        weights: (R, S) or (N,), optional.

    Returns:
        (R, ...); zero for rays without samples.

    Raises:
        ValueError: if the leading axes are not those of the samples.
    """
    leading = values.shape[: samples.starts.dim()]
    if leading != samples.starts.shape:
        expected = ", ".join(str(size) for size in (*samples.starts.shape, "..."))
        raise ValueError(f"values must have shape ({expected}), got {tuple(values.shape)}")
    values = at_least_float32(values)
    if weights is not None:
        check_shape("weights", weights, samples.starts.shape)
    if samples.is_packed:
        flat = values if values.dim() == 1 else values.flatten(1)
        summed = packed_sum(flat, weights, samples.offsets)
        return summed if values.dim() == 1 else summed.unflatten(1, values.shape[1:])
    if weights is not None:
        values = values * weights.reshape(*weights.shape, *[1] * (values.dim() - weights.dim()))
    return values.sum(dim=1)


def safe_divide(numerator: Tensor, denominator: Tensor, faint: float = 0.0) -> Tensor:
    """Quotient that is 0 where the denominator is 0, and has no gradient where that is at most `faint` (>= 0)."""
    zero = denominator == 0
    if faint:
        is_faint = denominator <= faint
        numerator = torch.where(is_faint, numerator.detach(), numerator)
        denominator = torch.where(is_faint, denominator.detach(), denominator)
    return torch.where(zero, torch.zeros_like(numerator), numerator / torch.where(zero, 1.0, denominator))


def composite(
    samples: Samples, output: FieldOutput, background: Tensor | None = None, *, quadrature: str = "constant"
) -> Rendering:
    """Composite a field's output along rays into colour, opacity and expected depth.

    Args:
        samples: dense or packed intervals of R rays.
        output: the field at the samples' points, laid out like them.
        background: (R, 3) or (3,) colour behind the rays; None is black.
        quadrature: how density between samples is read, "constant", "linear" or "parabolic": see
            `dnerf.core.quadrature`.

    Returns:
        A `Rendering`; rays without samples show the background.

    Raises:
        ValueError: if shapes do not fit, or for another rule.
    """
    check_shape("density", output.density, samples.starts.shape)
    check_shape("rgb", output.rgb, (*samples.starts.shape, 3))
    density = torch.full_like(output.density, OPAQUE) if samples.is_opaque else output.density
    depths, shares = optical_depths(at_least_float32(density), samples, quadrature)
    weights = render_weights(depths, samples)
    if shares is not None:
        weights = spread_weights(weights, shares, samples)
    columns = torch.cat(
        [at_least_float32(output.rgb).to(weights.dtype), samples.distances[..., None].to(weights.dtype),
         torch.ones_like(weights)[..., None]], dim=-1,
    )  # fmt: skip
    sums = sum_along_rays(columns, samples, weights)
    rgb, depth, opacity = sums[:, :3], sums[:, 3], sums[:, 4].clamp(max=1)
    rendering = Rendering(
        rgb=rgb, opacity=opacity, depth=safe_divide(depth, opacity, FAINT), weights=weights, samples=samples,
        output=output,
    )  # fmt: skip
    return rendering if background is None else over(rendering, background)


def over(rendering: Rendering, background: Tensor) -> Rendering:
    """A rendering of R rays without a background, over one, (R, 3) or (3,); ValueError for another shape."""
    if background.shape != (3,):
        check_shape("background", background, (len(rendering.rgb), 3))
    background = background.to(rendering.rgb.dtype).expand(len(rendering.rgb), 3)
    rgb = rendering.rgb + (1 - rendering.opacity)[:, None] * background
    return replace(rendering, rgb=rgb, background=background)


def median_depth(rendering: Rendering) -> Tensor:
    """Distance (R,) by which half of the light that a ray loses is absorbed, in world units; 0 where it loses none.

    At edges the expected depth lies in the empty space between what is in front and what is behind; this one does not.
    Within a sample light is taken to be absorbed evenly, which errs by less than its length.

    Raises:
        ValueError: for a rendering without per-sample data (a whole image's).
    """
    samples, weights = rendering.samples, rendering.weights
    if samples is None or weights is None:
        raise ValueError("rendering must have per-sample data, got that of a whole image")
    if not weights.numel():
        return torch.zeros_like(rendering.depth)
    count = weights.numel()
    if samples.is_packed:
        offsets = samples.offsets
    else:
        offsets = weights.shape[-1] * torch.arange(samples.num_rays + 1, device=weights.device)
    # Shares of what each ray absorbs: faint rays are as exact as others, and one that is no number spoils no other.
    totals = sum_along_rays(weights.double(), samples)
    shares = weights.double() / samples.per_sample(totals)
    flat = torch.where(samples.per_sample(totals.isfinite() & (totals > 0)), shares, 0).reshape(-1)
    absorbed = torch.nn.functional.pad(flat.cumsum(0), (1, 0))
    begin, end = absorbed[offsets[:-1]], absorbed[offsets[1:]]
    halves = 0.5 * (begin + end)
    reached = torch.searchsorted(absorbed, halves).sub(1).clamp(min=0, max=count - 1)  # absorbed[k] < half <= [k + 1]
    share = ((halves - absorbed[reached]) / flat[reached].clamp(min=torch.finfo(flat.dtype).tiny)).clamp(0, 1)
    starts, ends = (x.reshape(-1)[reached].double() for x in (samples.starts, samples.ends))
    depth = torch.where(end > begin, torch.lerp(starts, ends, share), 0)
    return torch.where(totals.isfinite(), depth, torch.nan).to(rendering.depth.dtype)
