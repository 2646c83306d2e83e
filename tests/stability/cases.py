"""Hard inputs in large batches, in float32, and the same numbers in float64 as truth."""

from collections.abc import Callable

import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput, Rendering, composite
from dnerf.core.rays import Samples


def random_depths(num_rays: int, num_samples: int, seed: int) -> Tensor:
    """Optical depths (R, S) in float32 from 1e-12 to 1e6, evenly spread in their logarithm, a tenth of them zero.

    A third of the rays is thin (sum below about 1), a third dense, a third everything at once.
    """
    generator = torch.Generator().manual_seed(seed)
    kind = torch.arange(num_rays)[:, None] % 3
    low = torch.tensor([-12.0, -3.0, -12.0])[kind]
    high = torch.tensor([-2.0, 2.0, 6.0])[kind]
    depths = 10 ** (low + (high - low) * torch.rand(num_rays, num_samples, generator=generator))
    return depths * (torch.rand(num_rays, num_samples, generator=generator) > 0.1)


def unit_samples(num_rays: int, num_samples: int, dtype: torch.dtype = torch.float32) -> Samples:
    """Intervals of length 2^-7 from 1 on: exact in every precision, so that optical depths are what was asked for."""
    starts = (1 + torch.arange(num_samples, dtype=dtype) / 128).expand(num_rays, -1)
    return Samples(starts, starts + 1 / 128, num_rays)


def image(depths: Tensor, rgb: Tensor, background: Tensor, packed: bool, **options: object) -> Rendering:
    """Composite optical depths (R, S)."""
    num_rays, num_samples = depths.shape
    samples = unit_samples(num_rays, num_samples, depths.dtype)
    density = depths * 128
    if packed:
        return composite(
            samples.packed(), FieldOutput(density.flatten(), rgb.flatten(0, 1)), background, **options
        )  # fmt: skip
    return composite(samples, FieldOutput(density, rgb), background, **options)


def value_and_gradients(function: Callable[..., Tensor], *inputs: Tensor) -> tuple[Tensor, list[Tensor]]:
    """A function's value and the gradients of its sum with respect to every input."""
    leaves = [x.detach().clone().requires_grad_() for x in inputs]
    value = function(*leaves)
    return value.detach(), list(torch.autograd.grad(value.sum(), leaves))


def relative(approximate: Tensor, exact: Tensor, floor: float = 0.0) -> Tensor:
    """Error of each number relative to its exact value, or to `floor` where that is smaller."""
    return (approximate.double() - exact).abs() / exact.abs().clamp(min=max(floor, 1e-300))
