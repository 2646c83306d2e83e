"""Which pixels a training step learns from."""

from abc import ABC, abstractmethod
from bisect import bisect_right
from itertools import accumulate

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_positive, check_whole
from dnerf.data.frames import Frames
from dnerf.data.pixel_layout import PixelLayout

SAME_TIME = 1e-6  # frames no further from the origin than others are in with them
UNKNOWN = 1.0  # error of a block that was never drawn: as wrong as colours can be
LEAST, MOST = 1e-6, 1 - 1e-6  # that a known block keeps: something can be drawn where nothing is wrong


class PixelSampler(nn.Module, ABC):
    """Draws the pixels of a training step; what it has learnt belongs into checkpoints, as buffers."""

    def begin(self, frames: Frames) -> None:
        """Get to know the frames, on their device, before the first step."""

    @abstractmethod
    def draw(self, count: int, progress: float, generator: torch.Generator) -> Tensor:
        """Random pixels (count,) int64, with repetition, see `Frames.pixels`.

        Progress of training is in [0, 1]; the generator is on the device of the frames.
        """

    def feedback(self, indices: Tensor, errors: Tensor) -> None:
        """Learn how wrong pixels (R,) were; does nothing unless overridden.

        Errors (R,) are squares of their colours', negative where a ray was not rendered.
        """


class FrameSubset(ABC):
    """A pixel sampler that draws from some of the frames only."""

    @abstractmethod
    def frames_in(self, progress: float) -> Tensor | None:
        """Numbers (n,) of the frames that are drawn from at a progress in [0, 1]; None for all."""


class UniformPixels(PixelSampler):
    """All pixels of all frames alike."""

    def __init__(self) -> None:
        super().__init__()
        self._num_pixels = 0

    def begin(self, frames: Frames) -> None:
        """Count the pixels."""
        self._num_pixels = frames.num_pixels

    def draw(self, count: int, progress: float, generator: torch.Generator) -> Tensor:
        """Pixels (count,) of all frames."""
        return torch.randint(self._num_pixels, (count,), generator=generator, device=generator.device)


class TemporalCurriculum(PixelSampler, FrameSubset):
    """Training begins with the frames nearest in time to an origin; the others come in as it goes on.

    A field that sees all times at once first learns their blur, and may explain motion by density that comes and goes.
    Near the origin little has moved; what comes in later lies close to where the deformation already leads. Learning
    rates should be held until all frames are in (`AdamSettings.hold_until`): the last ones have as far to go.

    Source: D-NeRF's code (`precrop_iters_time`), there from time 0.

    Args:
        end: fraction of training, in (0, 1], at which all frames are in.
        start: share of the frames that are in at first, in (0, 1]; one frame at least, and those of the same time.
        origin: time in [0, 1] around which the window opens.
    """

    def __init__(self, end: float = 0.3, start: float = 0.05, *, origin: float = 0.5) -> None:
        super().__init__()
        if not 0 <= origin <= 1:
            raise ValueError(f"origin must be in [0, 1], got {origin}")
        for name, value in (("end", end), ("start", start)):
            check_positive(name, value)
            if value > 1:
                raise ValueError(f"{name} must be in (0, 1], got {value}")
        self.origin, self.end, self.start = origin, end, start
        self._nearest = torch.empty(0, dtype=torch.int64)  # frames from the origin outwards
        self._counts: list[int] = []  # pixels of those frames, up to and with each
        self._ends = torch.empty(0, dtype=torch.int64)  # the same
        self._shifts = torch.empty(0, dtype=torch.int64)  # from those pixels to those of all frames
        self._distances: list[float] = []  # of those

    def begin(self, frames: Frames) -> None:
        """Sort the frames by their distance in time from the origin."""
        distances, self._nearest = (frames.times - self.origin).abs().sort(stable=True)
        starts = frames.layout.starts
        order = self._nearest.tolist()
        self._counts = list(accumulate(starts[i + 1] - starts[i] for i in order))
        self._ends = torch.tensor(self._counts, device=self._nearest.device)
        self._shifts = torch.tensor([starts[i + 1] for i in order], device=self._nearest.device) - self._ends
        self._distances = distances.tolist()

    def frames_in(self, progress: float) -> Tensor | None:
        """Numbers (n,) of the frames that are in; None once all are."""
        count = len(self._distances)
        share = self.start + (1 - self.start) * min(progress / self.end, 1.0)
        num_frames = min(max(round(share * count), 1), count)
        if num_frames < count:
            num_frames = bisect_right(self._distances, self._distances[num_frames - 1] + SAME_TIME)
        return None if num_frames == count else self._nearest[:num_frames]

    def draw(self, count: int, progress: float, generator: torch.Generator) -> Tensor:
        """Pixels (count,) of the frames that are in."""
        frames = self.frames_in(progress)
        num_pixels = self._counts[-1 if frames is None else len(frames) - 1]
        drawn = torch.randint(num_pixels, (count,), generator=generator, device=generator.device)
        if frames is None:
            return drawn
        return drawn + self._shifts[torch.searchsorted(self._ends, drawn, right=True)]


class ErrorGuidedPixels(PixelSampler, FrameSubset):
    """Another pixel sampler's pixels, of which a share is drawn anew where images are wrong.

    Frames are cut into square blocks that know the squared error of the rays drawn in them of late. Blocks are drawn in
    proportion to it, pixels evenly within a block. Draws are not weighted back.

    Source: the error map of instant-ngp's code (Mueller et al. 2022), for many frames of few blocks each.

    Args:
        pixels: draws the other pixels, and says which frames are in.
        share: of the pixels, in [0, 1].
        resolution: most blocks along a frame's longer side.
        memory: of what a block knew, what it keeps in a step that draws it, in [0, 1).
    """

    def __init__(
        self, pixels: PixelSampler, share: float = 0.125, *, resolution: int = 50, memory: float = 0.5
    ) -> None:
        super().__init__()
        check_whole("resolution", resolution)
        if not 0 <= share <= 1:
            raise ValueError(f"share must be in [0, 1], got {share}")
        if not 0 <= memory < 1:
            raise ValueError(f"memory must be in [0, 1), got {memory}")
        self.pixels = pixels
        self.share, self.resolution, self.memory = share, resolution, memory
        self._layout: PixelLayout | None = None
        self._block = 1
        self.register_buffer("errors", torch.empty(0, 0, 0))
        self.errors: Tensor

    def begin(self, frames: Frames) -> None:
        """Know nothing of these frames; unknown blocks are drawn first."""
        self.pixels.begin(frames)
        self._layout = frames.layout
        sizes = frames.layout.sizes
        self._block = -(-max(map(max, sizes)) // self.resolution)
        blocks = [[-(-side // self._block) for side in size] for size in sizes]
        rows, columns = (max(each[axis] for each in blocks) for axis in (0, 1))
        self.errors = torch.full((len(frames), rows, columns), UNKNOWN, device=frames.images.device)
        # Blocks beyond a smaller frame are never drawn.
        for errors, (rows, columns) in zip(self.errors, blocks):
            errors[rows:], errors[:, columns:] = 0, 0

    def frames_in(self, progress: float) -> Tensor | None:
        """See `FrameSubset`: those of the other pixel sampler."""
        return self.pixels.frames_in(progress) if isinstance(self.pixels, FrameSubset) else None

    def draw(self, count: int, progress: float, generator: torch.Generator) -> Tensor:
        """Pixels (count,), the guided ones last."""
        even = self.pixels.draw(count, progress, generator)
        guided = int(self.share * count)
        assert self._layout is not None
        frames_in = self.frames_in(progress)
        errors = self.errors if frames_in is None else self.errors.index_select(0, frames_in)
        bounds = errors.reshape(-1).cumsum(0, dtype=torch.float64)
        unit = torch.rand(3, guided, dtype=torch.float64, generator=generator, device=generator.device)
        blocks = torch.searchsorted(bounds, unit[0] * bounds[-1], right=True).clamp_(max=len(bounds) - 1)
        frames, within = blocks // errors[0].numel(), blocks % errors[0].numel()
        if frames_in is not None:
            frames = frames_in[frames]
        height, width = self._layout.sides(frames)
        rows = self._within(within // errors.shape[2], unit[1], height)
        columns = self._within(within % errors.shape[2], unit[2], width)
        return torch.cat([even[: count - guided], self._layout.index(frames, rows, columns)])

    @torch.no_grad()
    def feedback(self, indices: Tensor, errors: Tensor) -> None:
        """Enter squared errors; one that is no number counts as unknown."""
        self.pixels.feedback(indices, errors)
        assert self._layout is not None
        frames, rows, columns = self._layout.locate(indices)
        blocks = frames * self.errors.shape[1] + rows // self._block
        blocks = blocks * self.errors.shape[2] + columns // self._block
        known = self.errors.view(-1)
        is_rendered = (~(errors < 0)).to(known.dtype)  # NaN is
        errors = torch.where(errors <= 1, errors.clamp(LEAST, MOST), UNKNOWN).to(known.dtype)
        sums, counts = (
            torch.zeros_like(known).index_add_(0, blocks, each) for each in (errors * is_rendered, is_rendered)
        )
        before, now = known[blocks], sums[blocks] / counts[blocks].clamp(min=1)
        now = torch.where(before < UNKNOWN, torch.lerp(now, before, self.memory), now)
        known[blocks] = torch.where(counts[blocks] > 0, now, before)

    def _within(self, blocks: Tensor, unit: Tensor, side: int | Tensor) -> Tensor:
        """Random rows or columns of blocks; the last block may be cut."""
        begins = blocks * self._block
        return begins + (unit * (side - begins).clamp(max=self._block)).long()
