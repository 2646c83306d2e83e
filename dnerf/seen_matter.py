"""Where training's pictures show matter: points on which to judge motion."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.checks import check_positive
from dnerf.data.frames import Frames
from dnerf.renderer import Renderer

CHUNK = 16384  # rays at a time


@dataclass(frozen=True)
class SeenMatter:
    """Matter that pictures show.

    Args:
        positions: (N, 3) in world units.
        times: (N,) in [0, 1].
    """

    positions: Tensor
    times: Tensor


@torch.no_grad()
def seen_matter(renderer: Renderer, frames: Frames, num_rays: int, generator: torch.Generator) -> SeenMatter:
    """Samples of rays through random pixels, each kept with the chance of its share in the picture.

    Args:
        renderer: in evaluation mode; its field tells positions and times of its samples, as a `DeformedField` does.
        frames: whose pixels rays go through, on the renderer's device.
        num_rays: how many.
        generator: of all randomness.

    Raises:
        ValueError: if there is to be no ray.
    """
    check_positive("num_rays", num_rays)
    device = renderer.device
    indices = torch.randint(frames.num_pixels, (num_rays,), generator=generator, device=device)
    positions, times = [], []
    for part in indices.split(CHUNK):
        rendering = renderer(frames.pixels(part)[0])
        assert rendering.output is not None
        assert rendering.weights is not None
        weights, extras = rendering.weights.reshape(-1), rendering.output.extras
        kept = torch.rand(weights.shape, generator=generator, device=device) < weights
        positions.append(extras["positions"].reshape(-1, 3)[kept])
        times.append(extras["times"].reshape(-1)[kept])
    return SeenMatter(torch.cat(positions), torch.cat(times))
