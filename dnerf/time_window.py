"""Frames that come in by time: motion is found from one moment outwards, instead of everywhere at once."""

from bisect import bisect_right

import torch
from torch import Tensor

from dnerf.checks import check_positive

MIDDLE = 0.5
SAME_TIME = 1e-6  # frames no further from the origin than others are in with them


class TimeWindow:
    """Training begins with the frames nearest in time to an origin; the others come in as it goes on.

    A field that sees all times at once first learns their blur, and may explain motion by matter that comes and goes.
    Near the origin little has moved; what comes in later lies close to where the deformation already leads. The trainer
    holds its learning rates until all frames are in: the last ones have as far to go as the first.
    Source: D-NeRF's code (`precrop_iters_time`), there from time 0.

    Args:
        origin: time in [0, 1] around which the window opens; None for that at which the pictures show most of the
            scene (`open_around` tells it; the middle of the film until then).
        end: fraction of training, in (0, 1], at which all frames are in.
        start: share of the frames that are in at first, in (0, 1]; one frame at least, and those of the same time.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(self, origin: float | None = 0.0, end: float = 0.6, start: float = 0.05) -> None:
        if origin is not None and not 0 <= origin <= 1:
            raise ValueError(f"origin must be in [0, 1] or None, got {origin}")
        for name, value in (("end", end), ("start", start)):
            check_positive(name, value)
            if value > 1:
                raise ValueError(f"{name} must be in (0, 1], got {value}")
        self.origin = MIDDLE if origin is None else origin
        self.is_given = origin is not None
        self.end = end
        self.start = start
        self._sorted: tuple[Tensor, Tensor, list[float]] | None = None  # times, their order, distances in that order

    def open_around(self, time: float) -> None:
        """Open around this time, unless another one was asked for.

        Args:
            time: in [0, 1], see `dnerf.silhouettes.most_shown_time`.
        """
        if not self.is_given:
            self.origin = time
            self._sorted = None

    def num_frames(self, count: int, progress: float) -> int:
        """How many of `count` frames are in at a progress in [0, 1]."""
        share = self.start + (1 - self.start) * min(progress / self.end, 1.0)
        return min(max(round(share * count), 1), count)

    def since_open(self, progress: float) -> float:
        """How much of the training that sees all frames is over, in [0, 1]; 0 before, and throughout if `end` is 1."""
        return max(progress - self.end, 0.0) / (1 - self.end) if self.end < 1 else 0.0

    def steps_since_open(self, step: int, progress: float) -> float | None:
        """About how many of `step` steps saw all frames, None before any can; steps take equal shares of progress."""
        return None if progress < self.end else step * (1 - self.end / progress)

    def draw(
        self, times: Tensor, num_pixels: int, count: int, progress: float, *, generator: torch.Generator
    ) -> Tensor:
        """Random pixels of the frames that are in.

        Args:
            times: (F,) of all frames, in [0, 1].
            num_pixels: of all frames together, F of equal size one after the other.
            count: how many to draw, with repetition.
            progress: of training, in [0, 1].
            generator: on the device of the times.

        Returns:
            (count,) int64 in [0, num_pixels). Once all frames are in, what `torch.randint` gives.
        """
        frames = self.frames_in(times, progress)
        size = num_pixels // len(times)
        num_frames = len(times) if frames is None else len(frames)
        drawn = torch.randint(num_frames * size, (count,), generator=generator, device=generator.device)
        return drawn if frames is None else frames[drawn // size] * size + drawn % size

    def frames_in(self, times: Tensor, progress: float) -> Tensor | None:
        """Numbers (n,) of the frames that are in, of times (F,); None once all are."""
        num_frames = self.num_frames(len(times), progress)
        if num_frames == len(times):
            return None
        nearest, distances = self._from_origin(times)
        num_frames = bisect_right(distances, distances[num_frames - 1] + SAME_TIME)
        return None if num_frames == len(times) else nearest[:num_frames]

    def _from_origin(self, times: Tensor) -> tuple[Tensor, list[float]]:
        """Frames from the origin outwards, and how far they are; asked once for one tensor of times."""
        if self._sorted is None or self._sorted[0] is not times:
            distances, order = (times - self.origin).abs().sort(stable=True)
            self._sorted = times, order, distances.tolist()
        return self._sorted[1:]
