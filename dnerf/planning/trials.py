"""Candidates trained against each other from the same weights, and compared on frames that none has seen."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.data.frames import Frames, composite_on
from dnerf.rendering.renderer import Renderer
from dnerf.training.averaging import WeightAverage
from dnerf.training.inheritance import take_over
from dnerf.training.run import Run
from dnerf.training.trainer import Trainer

Maker = Callable[[Mapping[str, str]], tuple[Renderer, Trainer]]
"""The model and the trainer for choices of candidates by part."""

HELD = (8, 4, 3, 2)  # one frame of so many is held out, of the most that give `LEAST_HELD`
LEAST_HELD = 3  # frames to compare on; one has no standard error
LEAST_FRAMES = 8  # of the training split, below which none is held out
NUM_RAYS = 8192  # of a comparison
SPAN = 0.05  # of all steps done, over which weights are averaged for a comparison: steps of one size are noisy
AVERAGE = "average"  # callback


@dataclass(frozen=True)
class Effort:
    """What each candidate may spend: seconds if these end training (a part must earn what it costs), else steps."""

    num_steps: int
    seconds: float  # that so many steps of the model that stands take

    def divided(self, number: int) -> "Effort":
        """One of so many equal parts."""
        return Effort(max(1, self.num_steps // number), self.seconds / number)


class Contender:
    """One candidate in training."""

    def __init__(self, choice: str, trainer: Trainer, run: Run) -> None:
        self.choice, self.trainer, self.run = choice, trainer, run
        self.errors = torch.empty(0)  # (F,) mean squared, of each held-out frame
        self.has_failed = False
        self.average = WeightAverage(SPAN, every=1)

    @classmethod
    def fresh(cls, choice: str, make: Maker, choices: Mapping[str, str], frames: Frames, seed: int) -> "Contender":
        """One from scratch."""
        renderer, trainer = make(choices)
        return cls(choice, trainer, trainer.begin(renderer, frames, seed=seed))

    def forked(self, choice: str, make: Maker, choices: Mapping[str, str], frames: Frames, seed: int) -> "Contender":
        """Another candidate that goes on from where this one stands."""
        other = Contender.fresh(choice, make, choices, frames, seed)
        take_over(other.run, self.run)
        return other

    def advance(self, effort: "Effort") -> None:
        """Take steps until the effort is spent, or training ends, or fails, which is noted."""
        run, limits = self.run, self.trainer.limits
        step, seconds = run.step + effort.num_steps, run.seconds + effort.seconds

        def is_done() -> bool:
            enough = run.step >= step if limits.max_seconds is None else run.seconds >= seconds
            return enough or limits.is_finished(run.step, run.seconds)

        try:
            self.trainer.advance(run, is_done)
        except FloatingPointError:
            self.has_failed = True

    def begin(self) -> None:
        """Average the weights from now on."""
        self.average = WeightAverage(SPAN, every=1)
        self.run.callbacks = {**self.run.callbacks, AVERAGE: self.average}
        self.average.on_train_begin(self.run)

    @torch.no_grad()
    def compare(self, held: "HeldOut") -> None:
        """Note the errors of the averaged weights on held-out frames: infinite ones of a candidate that failed."""
        renderer = self.run.renderer
        weights = {name: x.detach().clone() for name, x in renderer.named_parameters()}
        self.average.on_train_end(self.run)
        errors = held.errors(renderer)
        for name, parameter in renderer.named_parameters():
            parameter.copy_(weights[name])
        renderer.invalidate()
        self.average.on_train_begin(self.run)
        self.errors = torch.full_like(errors, math.inf) if self.has_failed else errors

    def end(self) -> None:
        """Average no more."""
        self.run.callbacks = {name: x for name, x in self.run.callbacks.items() if name != AVERAGE}


@dataclass(frozen=True)
class HeldOut:
    """Pixels of frames that trials do not train on."""

    frames: Frames
    indices: Tensor  # (F, P) int64, pixels of each frame

    @classmethod
    def of(cls, frames: Frames, seed: int) -> "HeldOut":
        """The same number of random pixels of each frame."""
        generator = torch.Generator().manual_seed(seed)
        size = frames.num_pixels // len(frames)
        pixels = torch.randint(size, (len(frames), max(1, NUM_RAYS // len(frames))), generator=generator)
        pixels = pixels + size * torch.arange(len(frames))[:, None]
        return cls(frames, torch.stack([frames.counted(row) for row in pixels.to(frames.images.device)]))

    def within(self, times: Tensor) -> "HeldOut":
        """Those frames whose times lie between the first and the last of some; all, if fewer than two do."""
        own = self.frames.times[self.indices[:, 0] // (self.frames.num_pixels // len(self.frames))]
        kept = ((own >= times.min()) & (own <= times.max())).nonzero()[:, 0]
        return self if len(kept) < 2 else HeldOut(self.frames, self.indices[kept])

    @torch.no_grad()
    def errors(self, renderer: Renderer) -> Tensor:
        """Mean squared errors (F,) of the frames, rendered as training does; the same draws at every call."""
        rays, rgba = self.frames.pixels(self.indices.flatten().to(renderer.device))
        generator = torch.Generator(renderer.device).manual_seed(0)
        rendering = renderer(rays, generator=generator)
        assert rendering.background is not None
        squares = (rendering.rgb - composite_on(rgba, rendering.background)).square().mean(-1)
        return squares.view(self.indices.shape).double().mean(1).cpu()


def split_frames(frames: Frames) -> tuple[Frames, Frames] | None:
    """Frames to train on and frames to compare on, spread in time and over the cameras of a rig; None for too few."""
    if len(frames) < LEAST_FRAMES:
        return None
    every = next(number for number in HELD if len(frames) >= LEAST_HELD * number)
    order = frames.times.argsort(stable=True).tolist()
    # Another of each eight: of four cameras that take turns, every eighth frame is the same one's.
    places = (start + (every // 2 + 3 * (start // every)) % every for start in range(0, len(order), every))
    held = [order[place] for place in places if place < len(order)]
    return frames.subset([i for i in range(len(frames)) if i not in set(held)]), frames.subset(held)


def gain(better: Tensor, worse: Tensor) -> tuple[float, float]:
    """By how much some errors (F,) are smaller than others, in dB, and the standard error of that.

    The frames are taken as independent, their differences as paired: what both candidates find hard does not count. The
    error is infinite for a single frame, which says nothing of others.
    """
    if not bool(better.isfinite().all()):
        return -math.inf, 0.0
    if not bool(worse.isfinite().all()):
        return math.inf, 0.0
    differences = 10 * (worse.clamp(min=1e-12) / better.clamp(min=1e-12)).log10()
    share = worse / worse.sum().clamp(min=1e-30)  # of the whole error: a frame without any says nothing
    mean = float((share * differences).sum())
    count = len(share)
    spread = float((share.square() * (differences - mean).square()).sum().sqrt())
    return mean, spread * math.sqrt(count / (count - 1)) if count > 1 else math.inf  # the mean is theirs


@dataclass(frozen=True)
class Result:
    """What a contest came to."""

    winner: Contender
    gain: float  # over the second, in dB
    error: float  # standard error of that
    seconds: float  # that comparisons took


def contest(contenders: Sequence[Contender], held: HeldOut, effort: Effort) -> Result:
    """Train all, halving the number of challengers until one is left.

    The first contender is the one that stands. Another one wins if it is better by a standard error: Breiman et al.
    (1984) ask as much of a larger tree.

    Args:
        contenders: at least two, the default first.
        held: what they are compared on.
        effort: of each until the last comparison, in as many rounds as there are halvings.
    """
    left, seconds = list(contenders), 0.0
    for contender in contenders:
        contender.begin()
    num_rounds = (len(left) - 1).bit_length()
    for _ in range(num_rounds):
        for contender in left:
            contender.advance(effort.divided(num_rounds))
        begin = time.perf_counter()
        inside = held
        for contender in left:
            frames_in = contender.trainer.frames_in(contender.run.progress)  # None for all
            times = contender.run.frames.times
            inside = inside.within(times if frames_in is None else times[frames_in])
        for contender in left:
            contender.compare(inside)
        seconds += time.perf_counter() - begin
        if len(left) > 2:
            others = sorted(left[1:], key=lambda c: float(c.errors.mean()))
            left = [left[0], *others[: len(others) // 2]]  # the one that stands is compared to the end
    for contender in contenders:
        contender.end()
    standing, other = left
    mean, error = gain(other.errors, standing.errors)
    return Result(other, mean, error, seconds) if mean > error else Result(standing, -mean, error, seconds)
