"""Where training's pictures are wrong, so that rays are drawn there."""

import torch
from torch import Tensor, nn

from dnerf.checks import check_positive
from dnerf.data.frames import Frames
from dnerf.time_window import TimeWindow

UNSEEN = 1.0  # as wrong as colours can be
LEAST, MOST = 1e-6, 1 - 1e-6  # that a seen block knows: something can be drawn where nothing is wrong


class ErrorMap(nn.Module):
    """A share of each step's rays is drawn where pictures are wrong.

    Frames are cut into square blocks that know the squared error of the rays drawn in them of late. Blocks are drawn in
    proportion to it, pixels evenly within a block; the other rays are drawn evenly, so that nothing is forgotten.
    Draws are not weighted back. A small body that moves fast is a thousandth of all pixels, seen from elsewhere at each
    time: evenly drawn rays rarely meet it, and nothing at all explains what they meet best.

    Source: the error map of instant-ngp's code (Mueller et al. 2022), for many frames of few blocks each.

    Args:
        share: of the rays, in [0, 1].
        resolution: most blocks along a frame's longer side.
        memory: of what a block knew, what it keeps in a step that draws it, in [0, 1).

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(self, share: float = 0.125, resolution: int = 50, memory: float = 0.5) -> None:
        super().__init__()
        check_positive("resolution", resolution)
        if not 0 <= share <= 1:
            raise ValueError(f"share must be in [0, 1], got {share}")
        if not 0 <= memory < 1:
            raise ValueError(f"memory must be in [0, 1), got {memory}")
        self.share = share
        self.resolution = resolution
        self.memory = memory
        self.size = (0, 0)
        self.block = 1
        self.register_buffer("errors", torch.empty(0, 0, 0))
        self.errors: Tensor

    def begin(self, frames: Frames) -> None:
        """Know nothing, of these frames; unseen blocks are drawn first."""
        num_frames, *size = frames.images.shape[:3]
        self.size = (size[0], size[1])
        self.block = -(-max(size) // self.resolution)
        rows, columns = (-(-side // self.block) for side in size)
        self.errors = torch.full((num_frames, rows, columns), UNSEEN, device=frames.images.device)

    def num_even(self, count: int) -> int:
        """How many of so many pixels are drawn evenly; they come first."""
        return count - int(self.share * count)

    @torch.no_grad()
    def guide(self, indices: Tensor, frames_in: Tensor | None, *, generator: torch.Generator) -> Tensor:
        """Pixels of which the last share is drawn anew, where pictures are wrong.

        Args:
            indices: (R,) int64 of pixels, see `Frames.pixels`.
            frames_in: (n,) int64, frames that may be drawn; None for all.
            generator: on the device of the indices.

        Returns:
            (R,) int64.
        """
        count = len(indices) - self.num_even(len(indices))
        height, width = self.size
        errors = self.errors if frames_in is None else self.errors.index_select(0, frames_in)
        bounds = errors.reshape(-1).cumsum(0, dtype=torch.float64)
        unit = torch.rand(3, count, dtype=torch.float64, generator=generator, device=generator.device)
        blocks = torch.searchsorted(bounds, unit[0] * bounds[-1], right=True).clamp_(max=len(bounds) - 1)
        frames, within = blocks // errors[0].numel(), blocks % errors[0].numel()
        if frames_in is not None:
            frames = frames_in[frames]
        rows = self._within(within // errors.shape[2], unit[1], height)
        columns = self._within(within % errors.shape[2], unit[2], width)
        return torch.cat([indices[: len(indices) - count], (frames * height + rows) * width + columns])

    @torch.no_grad()
    def learn(self, indices: Tensor, errors: Tensor) -> None:
        """Enter the squared errors (R,) of pixels (R,).

        One that is no number counts as never seen, a negative one as not drawn.
        """
        height, width = self.size
        frames, rows, columns = indices // (height * width), indices // width % height, indices % width
        blocks = (frames * self.errors.shape[1] + rows // self.block) * self.errors.shape[2] + columns // self.block
        known = self.errors.view(-1)
        is_shown = (~(errors < 0)).to(known.dtype)  # NaN is
        errors = torch.where(errors <= 1, errors.clamp(LEAST, MOST), UNSEEN).to(known.dtype)
        sums, counts = (torch.zeros_like(known).index_add_(0, blocks, each) for each in (errors * is_shown, is_shown))
        before, now = known[blocks], sums[blocks] / counts[blocks].clamp(min=1)
        now = torch.where(before < UNSEEN, torch.lerp(now, before, self.memory), now)
        known[blocks] = torch.where(counts[blocks] > 0, now, before)

    def _within(self, blocks: Tensor, unit: Tensor, side: int) -> Tensor:
        """Random rows or columns of blocks; the last block may be cut."""
        begins = blocks * self.block
        return begins + (unit * (side - begins).clamp(max=self.block)).long()


def draw_pixels(
    frames: Frames,
    count: int,
    progress: float,
    window: TimeWindow | None,
    error_map: ErrorMap | None,
    *,
    generator: torch.Generator,
) -> Tensor:
    """Random pixels of the frames that are in, some of them where pictures are wrong.

    Args:
        frames: of which pixels are drawn, see `Frames.pixels`.
        count: how many, with repetition.
        progress: of training, in [0, 1].
        window: which frames are in; None for all.
        error_map: where pictures are wrong; None draws evenly.
        generator: on the device of the frames.

    Returns:
        (count,) int64.
    """
    if window is None:
        drawn = torch.randint(frames.num_pixels, (count,), generator=generator, device=generator.device)
    else:
        drawn = window.draw(frames.times, frames.num_pixels, count, progress, generator=generator)
    if error_map is None:
        return drawn
    frames_in = None if window is None else window.frames_in(frames.times, progress)
    return error_map.guide(drawn, frames_in, generator=generator)
