"""What changes while training goes on: plain functions of progress, and who listens to it."""

from abc import ABC, abstractmethod

from dnerf.core.checks import check_choice, check_positive, check_within

KINDS = ("linear", "exponential")


class Schedule(ABC):
    """A number that follows the progress of training."""

    @abstractmethod
    def __call__(self, progress: float) -> float:
        """The number at a progress in [0, 1]."""


class Ramp(Schedule):
    """From one number to another, between two points of training; constant before and after.

    Linear: v(p) = a + (b - a) s; exponential: v(p) = a (b / a)^s, with s = clamp((p - begin) / (end - begin), 0, 1).

    Args:
        start: a, until `begin`.
        stop: b, from `end` on.
        begin: progress in [0, 1).
        end: progress in (begin, 1].
        kind: "linear" or "exponential" (by equal ratios; for numbers above zero).

    Raises:
        ValueError: for numbers out of range, or another kind.
    """

    def __init__(
        self, start: float, stop: float, begin: float = 0.0, end: float = 1.0, *, kind: str = "linear"
    ) -> None:
        check_choice("kind", kind, KINDS)
        if not 0 <= begin < end <= 1:
            raise ValueError(f"begin and end must be 0 <= begin < end <= 1, got {begin} and {end}")
        for name, value in (("start", start), ("stop", stop)):
            check_positive(name, value, allow_zero=kind == "linear")
        self.start, self.stop, self.begin, self.end = float(start), float(stop), float(begin), float(end)
        self.kind = kind

    def __call__(self, progress: float) -> float:
        """The number at a progress in [0, 1]."""
        share = min(max((progress - self.begin) / (self.end - self.begin), 0.0), 1.0)
        if self.kind == "linear":
            return self.start + (self.stop - self.start) * share
        return self.start * (self.stop / self.start) ** share


class Fade(Ramp):
    """A weight that counts in full while a scene is being found, and little from then on: an exponential ramp.

    Args:
        start: the weight until `begin`.
        share: of it that is left from `end` on, in (0, 1].
        begin: progress in [0, 1), see `Ramp`.
        end: progress in (begin, 1].
    """

    def __init__(self, start: float, share: float = 0.03, begin: float = 0.3, end: float = 0.7) -> None:
        check_within("share", share, "(0, 1]")
        super().__init__(start, share * start, begin, end, kind="exponential")


def at(value: "float | Schedule", progress: float) -> float:
    """A number, or what a schedule gives at a progress."""
    return value(progress) if isinstance(value, Schedule) else float(value)


class Scheduled(ABC):
    """A module of which something follows progress: fields and samplers, whose doors carry none.

    `Renderer.set_progress` tells it, once before every step.
    """

    @abstractmethod
    def set_progress(self, progress: float) -> None:
        """Be as training at this progress in [0, 1] wants it; 1 is how evaluation wants it."""
