"""Frames replayed as CUDA graphs: an image is the same work every time, but for pose, time and sizes."""

from collections.abc import Callable, Hashable
from typing import Any

import torch
from torch import Tensor

from dnerf.core.cameras import Camera, camera_rays
from dnerf.core.rays import Rays
from dnerf.rendering.cuda_graphs import GraphCache

# What rays show, (R, C), when so many intervals can be marched and samples kept, and how many were wanted, (2,).
Show = Callable[[Rays, int, int], tuple[Tensor, Tensor]]

FIRST_GUESS = 4  # places per ray, before one image has told how many are wanted
HEADROOM = 1.3  # places for what other poses and times want
ROUND_TO = 2048  # places
MOST_VIEWS = 4  # sizes of images, lenses, planes and ways to show them, each of which has memory of its own


class FrameGraphs:
    """Images of one model, in as few places for samples as they take; graphs are recorded anew when more are needed.

    Args:
        device: of the model.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._cache = GraphCache(device)
        self._sizes: dict[Hashable, tuple[int, int]] = {}
        self._memory: Hashable = None

    def forget(self) -> None:
        """Drop all graphs, and the memory they hold."""
        self._cache.forget()
        self._sizes.clear()

    def __reduce__(self) -> tuple[type, tuple[torch.device]]:
        return FrameGraphs, (self.device,)

    @torch.no_grad()
    def image(self, camera: Camera, time: float, *, chunk: int, way: Hashable, memory: Hashable, show: Show) -> Tensor:
        """Columns (height * width, C) of what all pixels show.

        Args:
            camera: the view, on the model's device.
            time: in [0, 1].
            chunk: most rays at a time.
            way: what decides, beside values of tensors, what is shown; a few are kept.
            memory: where all tensors lie; elsewhere, all graphs are dropped.
            show: reads nothing from the device.
        """
        intrinsics = camera.intrinsics
        count = intrinsics.width * intrinsics.height
        rays = min(chunk, count)
        view = (intrinsics, camera.near, camera.far, camera.pose.dtype, rays, way)
        is_guess = view not in self._sizes
        if memory != self._memory or (is_guess and len(self._sizes) == MOST_VIEWS):
            self._cache.forget()
            self._sizes.clear()
            self._memory, is_guess = memory, True
        sizes = self._sizes.setdefault(view, (FIRST_GUESS * rays, FIRST_GUESS * rays))
        while True:
            parts, wanted = [], torch.zeros(2, dtype=torch.int64, device=self.device)
            for first in range(0, count, rays):
                part = self._part(camera, time, first, rays, sizes, show, view)
                parts.append(part["columns"].clone() if first + rays < count else part["columns"])
                wanted = torch.maximum(wanted, part["wanted"])
            needed = wanted.tolist()
            is_enough = all(n <= size for n, size in zip(needed, sizes, strict=True))
            if is_guess or not is_enough:
                marched, kept = (-(-int(n * HEADROOM + 1) // ROUND_TO) * ROUND_TO for n in needed)
                self._sizes[view] = sizes = (marched, kept)
                is_guess = False
            if is_enough:
                # Copied, because the next image is written into the same memory.
                return torch.cat(parts)[:count] if len(parts) > 1 else parts[0][:count].clone()

    def _part(
        self, camera: Camera, time: float, first: int, rays: int, sizes: tuple[int, int], show: Show, view: Hashable
    ) -> Any:
        intrinsics, dtype = camera.intrinsics, camera.pose.dtype
        last = intrinsics.width * intrinsics.height - 1

        def work(inputs: Tensor) -> dict[str, Tensor]:
            pixels = (inputs[17].long() + torch.arange(rays, device=inputs.device)).clamp(max=last)
            chosen = camera_rays(
                intrinsics, inputs[:16].view(4, 4).to(dtype), pixels % intrinsics.width, pixels // intrinsics.width,
                times=inputs[16].to(dtype).expand(rays), near=camera.near, far=camera.far,
            )  # fmt: skip
            columns, wanted = show(chosen, *sizes)
            return {"columns": columns, "wanted": wanted}

        # Pose, time and first pixel; all are exact in double precision.
        inputs = torch.empty(18, dtype=torch.float64, device=self.device)
        inputs[:16] = camera.pose.reshape(-1)
        inputs[16].fill_(time)
        inputs[17].fill_(first)
        return self._cache.run(view, sizes, work, inputs)
