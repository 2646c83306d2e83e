"""One optimiser step: pixels are rendered, compared and learnt from; op by op, or replayed as a CUDA graph."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager

import torch
from torch import Tensor, nn

from dnerf.data.frames import Frames, composite_on
from dnerf.graphs import GraphCache
from dnerf.missing_matter import lacking_opacity
from dnerf.optimizers import AdamMuon
from dnerf.recovery import what_is_shown
from dnerf.renderer import Renderer

LOOK_EVERY = 16  # steps between looks at how full fixed places are: each waits for the device
FULL = (0.8, 0.97)  # shares of fixed places that are left alone: another number of rays is another graph
AIM = 0.9
UPDATE = "update"
ERRORS = "errors of the pixels"
ROUND_TO = 256  # rays, where places are fixed


class Steps:
    """Optimiser steps of one run.

    Args:
        model: what is called with rays: the renderer, or what wraps it.
        renderer: whose parameters are optimised.
        frames: with the pixels to learn from, on the renderer's device.
        optimizer: of the parameters.
        generator: of all randomness.
        losses: terms by name, called as `Loss` is.
        loss_every: by name, steps between a term's turns, in which it counts as many times.
        shows: whether it is asked how much batches show, see `what_is_shown`.
        lacks: whether it is asked how much they lack, see `lacking_opacity`.
        fixed: samples for which the sampler has places, if their number is fixed.
        graphs: replays steps, for a fixed number of samples; None for steps op by op.
    """

    def __init__(
        self,
        model: nn.Module,
        renderer: Renderer,
        frames: Frames,
        optimizer: AdamMuon,
        generator: torch.Generator,
        *,
        losses: Mapping[str, nn.Module],
        loss_every: Mapping[str, int],
        shows: bool,
        lacks: bool = False,
        fixed: int | None = None,
        graphs: GraphCache | None = None,
    ) -> None:
        self.model = model
        self.renderer = renderer
        self.frames = frames
        self.optimizer = optimizer
        self.generator = generator
        self.losses = losses
        self.loss_every = loss_every
        self.shows = shows
        self.lacks = lacks
        self.fixed = fixed
        self.graphs = graphs
        self._num_samples = fixed or 0

    def __call__(
        self,
        indices: Tensor,
        number: int,
        weight: float,
        randomness: Callable[[], AbstractContextManager[None]],
        num_even: int | None = None,
    ) -> tuple[dict[str, Tensor], Tensor, int]:
        """Learn from some pixels.

        Args:
            indices: (R,) of the pixels.
            number: of the step, counted from 1: some losses take turns.
            weight: of the batch's loss.
            randomness: what random draws are made in.
            num_even: how many of the pixels, the first ones, were drawn evenly; None for all.

        Returns:
            Scalars on the device: the terms whose turn it is, "loss", "mse" and what else was asked for; and the
            squared errors (R,) of the pixels, -1 where a ray found no places; they hold until the next step. And the
            number of samples, padding aside; of a fixed number of places, how many were wanted when that was last
            looked at.
        """
        turns = [name for name in self.losses if number % self.loss_every.get(name, 1) == 0]

        def work(indices: Tensor) -> dict[str, Tensor]:
            with randomness():
                return self._optimize(indices, turns, weight, len(indices) if num_even is None else num_even)

        if self.graphs is None:
            found: Mapping[str, Tensor] = work(indices)
        else:
            state = (len(indices), weight, num_even, self.renderer.sampler.settings)
            found = self.graphs.run(tuple(turns), state, work, indices)
        if self.fixed is not None and number % LOOK_EVERY == 0:
            self._num_samples = int(self.renderer.sampler.fullness() * self.fixed)
        scalars = dict(found)
        return scalars, scalars.pop(ERRORS), self._num_samples

    def update(self, step: int) -> None:
        """Let the sampler learn from the field, between steps; `step` counts those done."""
        if self.graphs is None:
            self.renderer.update(step)
            return
        probes = self.renderer.sampler.probes(step)
        if probes is not None:
            self.graphs.run(UPDATE, len(probes), self._learn, probes)

    def _learn(self, probes: Tensor) -> dict[str, Tensor]:
        self.renderer.learn(probes)
        return {}

    def forget(self) -> None:
        """Record graphs anew: the optimiser's tensors have been replaced."""
        if self.graphs is not None:
            self.graphs.forget()

    def _optimize(self, indices: Tensor, turns: list[str], weight: float, num_even: int) -> dict[str, Tensor]:
        rays, rgba = self.frames.pixels(indices)
        rendering = self.model(rays, generator=self.generator)
        assert rendering.background is not None
        assert rendering.samples is not None
        if self.fixed is None:
            # Without what they were padded with: few samples would pass for many.
            self._num_samples = int((rendering.samples.lengths > 0).sum())
        target = composite_on(rgba, rendering.background)
        terms = {name: self.losses[name](rendering, target, self.renderer) for name in turns}
        total = rendering.rgb.new_zeros(())
        for name, term in terms.items():
            total = total + self.loss_every.get(name, 1) * term
        self.optimizer.zero_grad(set_to_none=True)
        if total.requires_grad:
            (total * weight if weight != 1 else total).backward()
            self.optimizer.step()
        errors = (rendering.rgb.detach() - target).square().mean(-1)
        known = errors if rendering.is_placed is None else torch.where(rendering.is_placed, errors, -1)
        shown = what_is_shown(rendering, target) if self.shows else {}
        if self.lacks:
            shown |= lacking_opacity(rendering, rgba, has_alpha=self.frames.has_alpha, num_even=num_even)
        found = {"loss": total, **terms, "mse": rendering.mean(errors), **shown, ERRORS: known}
        return {name: values.detach() for name, values in found.items()}


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


def next_num_rays(num_rays: int, num_samples: int, target: int, most: int, *, is_fixed: bool, step: int) -> int:
    """How many rays to take next, of which so many took `num_samples` samples where `target` are wanted.

    Args:
        num_rays: of the last step.
        num_samples: that they took.
        target: samples of a step.
        most: bound of the number of rays.
        is_fixed: whether samples have fixed places; how many were wanted is known every `LOOK_EVERY` steps then.
        step: steps done.
    """
    if not is_fixed:
        return int(min(max(num_rays * target / max(num_samples, 1), num_rays / 2, 1), num_rays * 2, most))
    return rays_that_fit(num_rays, num_samples / target, most) if step % LOOK_EVERY == 0 else num_rays


def rays_that_fit(num_rays: int, fullness: float, most: int) -> int:
    """How many rays to take next, of which so many filled that share of their fixed places."""
    if FULL[0] <= fullness <= FULL[1]:
        return num_rays
    wanted = max(int(min(num_rays * min(max(AIM / max(fullness, 1e-3), 0.25), 4), most)), 1)
    return wanted // ROUND_TO * ROUND_TO if wanted >= ROUND_TO else 1 << (wanted.bit_length() - 1)
