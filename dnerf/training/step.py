"""One optimiser step: pixels are rendered, compared and learnt from; op by op, or replayed as a CUDA graph."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import cast

import torch
from torch import Tensor

from dnerf.core.schedules import Schedule, at
from dnerf.data.frames import Frames, composite_on
from dnerf.losses.base import Batch, Loss
from dnerf.rendering.cuda_graphs import GraphCache
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import Capacity, FixedCapacity
from dnerf.training.run import Run

LOOK_EVERY = 16  # steps between looks at how full fixed places are: each waits for the device
FULL = (0.8, 0.97)  # shares of fixed places that are left alone: another number of rays is another graph
AIM = 0.9
ERRORS = "errors of the pixels"
ROUND_TO = 256  # rays, where places are fixed


@dataclass(frozen=True)
class StepResult:
    """What is found in a step; what lies on the device holds until the next."""

    scalars: Mapping[str, Tensor]  # loss terms by name, "loss", "mse", "opacity" and "contrast"
    errors: Tensor  # (R,) squared, of the pixels; -1 where a ray found no places
    num_samples: int  # padding aside; of a fixed number of places, how many were wanted when last looked at


class Stepper:
    """Takes the optimiser steps of one run.

    Args:
        run: whose renderer, losses, frames and optimiser are meant.
        capacity: places for samples, if their number is fixed.
        graphs: replays steps, for a fixed number of places; None for steps op by op.
    """

    def __init__(self, run: Run, capacity: Capacity | None, graphs: GraphCache | None) -> None:
        self.run, self.capacity, self.graphs = run, capacity, graphs
        self.losses: dict[str, Loss] = {name: cast(Loss, loss) for name, loss in run.losses.items()}
        device = run.renderer.device
        self._weights: dict[str, float | Tensor] = {  # what a schedule changes is a tensor: replayed steps read it
            name: torch.zeros((), device=device) if isinstance(x.weight, Schedule) else x.weight
            for name, x in self.losses.items()
        }
        self._num_samples = 0 if capacity is None else capacity.kept
        self._wanted = torch.zeros(2, dtype=torch.int64, device=device)

    def __call__(self, indices: Tensor) -> StepResult:
        """Learn from pixels of indices (R,)."""
        number = self.run.step + 1
        turns = [name for name, loss in self.losses.items() if number % loss.every == 0]
        for name, value in self._weights.items():
            if isinstance(value, Tensor):
                value.fill_(at(self.losses[name].weight, self.run.progress))
        work = partial(self._optimize, turns=turns)
        if self.graphs is None:
            found: Mapping[str, Tensor] = work(indices)
        else:
            state = (len(indices), self._sampler.path_key(), self.run.renderer.generation)
            found = self.graphs.run(tuple(turns), state, work, indices)
        if self.capacity is not None and number % LOOK_EVERY == 0:
            places = (self.capacity.marched, self.capacity.kept)
            fullness = max(wanted / size for wanted, size in zip(self._wanted.tolist(), places, strict=True))
            self._num_samples = int(fullness * self.capacity.kept)
        scalars = dict(found)
        return StepResult(scalars, scalars.pop(ERRORS), self._num_samples)

    @property
    def _sampler(self) -> FixedCapacity:
        assert isinstance(self.run.renderer.sampler, FixedCapacity)
        return self.run.renderer.sampler

    def update(self) -> None:
        """Let the sampler learn from the field, between steps."""
        renderer, step = self.run.renderer, self.run.step
        if self.graphs is None:
            renderer.update(step)
        elif (probes := self._sampler.probes(step)) is not None:
            self.graphs.run("update", (len(probes), renderer.generation), self._learn, probes)

    def _learn(self, probes: Tensor) -> dict[str, Tensor]:
        renderer = self.run.renderer
        with renderer.autocast(renderer.device):
            self._sampler.learn(renderer.field, probes)
        return {}

    def _optimize(self, indices: Tensor, turns: list[str]) -> dict[str, Tensor]:
        run = self.run
        rays, rgba = run.frames.pixels(indices)
        rendering = run.renderer(rays, generator=run.generator, capacity=self.capacity)
        samples = rendering.samples
        if samples.wanted is not None:
            self._wanted.copy_(samples.wanted)
        else:  # without what they were padded with: few samples would pass for many
            self._num_samples = int((samples.lengths > 0).sum())
        batch = Batch(rgba, composite_on(rgba, rendering.background))
        terms = {name: self.losses[name](rendering, batch, run.renderer) for name in turns}
        total = rendering.rgb.new_zeros(())
        for name, term in terms.items():
            total = total + self.losses[name].every * self._weights[name] * term
        run.optimizer.zero_grad(set_to_none=True)
        if total.requires_grad:
            total.backward()
            run.optimizer.step()
        opacity, variance = rendering.opacity.detach(), run.renderer.background.variance
        errors = (rendering.rgb.detach() - batch.target).square().mean(-1) + variance * (opacity - rgba[:, 3]).square()
        known = errors if rendering.is_placed is None else torch.where(rendering.is_placed, errors, -1)
        assert rendering.background is not None
        contrast = (batch.target - rendering.background).detach().square().amax(-1)
        contrast = (contrast + variance * rgba[:, 3].square()).sqrt()  # grey on grey is seen before other colours
        means = {"mse": errors, "opacity": opacity, "contrast": contrast}
        found = {"loss": total, **terms, **{name: rendering.mean(values) for name, values in means.items()}}
        return {name: values.detach() for name, values in {**found, ERRORS: known}.items()}


def warm_up(renderer: Renderer, frames: Frames) -> None:
    """Run every kernel once, forward and backward, so that their compilation is not timed.

    No parameter changes; a sampler that observes sees the untrained field at a few points.
    """
    generator = torch.Generator(frames.images.device).manual_seed(0)
    indices = torch.randint(frames.num_pixels, (64,), generator=generator, device=generator.device)
    loss = renderer(frames.pixels(indices)[0], generator=generator).rgb.sum()
    if loss.requires_grad:
        loss.backward()
    renderer.zero_grad(set_to_none=True)


def next_num_rays(num_rays: int, num_samples: int, target: int, most: int, step: int, *, is_fixed: bool) -> int:
    """How many rays to take after a step, at most `most`; it took `num_samples` samples where `target` are wanted.

    Where samples have fixed places, how many were wanted is known every `LOOK_EVERY` steps only.
    """
    if not is_fixed:
        return int(min(max(num_rays * target / max(num_samples, 1), num_rays / 2, 1), num_rays * 2, most))
    fullness = num_samples / target
    if step % LOOK_EVERY or FULL[0] <= fullness <= FULL[1]:
        return num_rays
    wanted = max(int(min(num_rays * min(max(AIM / max(fullness, 1e-3), 0.25), 4), most)), 1)
    return wanted // ROUND_TO * ROUND_TO if wanted >= ROUND_TO else 1 << (wanted.bit_length() - 1)
