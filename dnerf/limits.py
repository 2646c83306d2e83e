"""How long training goes on, and at which steps it is looked at."""

from dataclasses import dataclass

from dnerf.checks import check_positive, check_whole


@dataclass(frozen=True)
class Limits:
    """When training ends, writes a record, saves its state.

    Args:
        num_steps: most steps.
        max_seconds: most seconds, or None.
        log_every: steps between records.
        checkpoint_every: steps between checkpoints; None for none before the end.

    Raises:
        ValueError: for numbers that are not positive, or not whole where they count.
    """

    num_steps: int
    max_seconds: float | None
    log_every: int
    checkpoint_every: int | None

    def __post_init__(self) -> None:
        check_whole("num_steps", self.num_steps)
        check_whole("log_every", self.log_every)
        if self.checkpoint_every is not None:
            check_whole("checkpoint_every", self.checkpoint_every)
        if self.max_seconds is not None:
            check_positive("max_seconds", self.max_seconds)

    def progress(self, step: int, seconds: float, begun: float) -> float:
        """How much of training is over, in [0, 1]: of its steps or of its seconds, whichever is more.

        Args:
            step: steps done.
            seconds: spent.
            begun: seconds that had been spent before the first step.
        """
        of_time = 0.0
        if self.max_seconds is not None:
            left = self.max_seconds - begun
            of_time = (seconds - begun) / left if left > 0 else 1.0
        return min(max(step / self.num_steps, of_time), 1.0)

    def is_finished(self, step: int, seconds: float) -> bool:
        """Whether no step is left, or no time."""
        return step >= self.num_steps or (self.max_seconds is not None and seconds >= self.max_seconds)

    def is_saved(self, step: int) -> bool:
        """Whether the state after a step is, before the end."""
        return self.checkpoint_every is not None and step % self.checkpoint_every == 0

    def is_looked_at(self, step: int) -> bool:
        """Whether a step has a record; what is saved has one."""
        return step in (1, self.num_steps) or step % self.log_every == 0 or self.is_saved(step)
