"""Matter that pictures show and the model does not: where no motion explains it, features of space and time join."""

import logging
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from dnerf.checks import check_positive
from dnerf.compositing import Rendering
from dnerf.fields import SpaceTimeVolumes

logger = logging.getLogger(__name__)

NEEDED, LACKING = "needed opacity", "lacking opacity"


def lacking_opacity(rendering: Rendering, rgba: Tensor, *, has_alpha: bool, num_even: int) -> dict[str, Tensor]:
    """How much opacity a batch needs, and of how much of that it shows less than half; nothing waits for a device.

    Colours are in [0, 1], so a ray of opacity a differs from its background by a at most. Where pictures have no alpha,
    a ray whose true colour differs by d is therefore one that needs an opacity of d, whatever its matter's colour.

    Args:
        rendering: of the batch, with its background.
        rgba: (R, 4) true colours, premultiplied.
        has_alpha: whether their alpha says anything.
        num_even: how many rays count, the first ones: others were drawn where pictures are wrong.

    Returns:
        Two scalars, sums over the rays that count by the number of all.
    """
    background = 0.0 if rendering.background is None else rendering.background.detach()
    needed = rgba[:, 3] if has_alpha else (rgba[:, :3] - background).abs().amax(-1)
    if rendering.is_placed is not None:
        needed = torch.where(rendering.is_placed, needed, 0)
    lacking = torch.where(rendering.opacity.detach() < needed / 2, needed, 0)
    return {name: x[:num_even].sum() / max(len(x), 1) for name, x in ((NEEDED, needed), (LACKING, lacking))}


class MissingMatterCheck:
    """Lets waiting space-time volumes join once it is clear that the deformation does not find what moves.

    A deformation follows matter from frame to frame. What moves by about its own size between two frames, or goes round
    among others, it may never find, and its pictures lack it. Volumes of space and time need no motion to show it, but
    they see each moment from one side only and make pictures dearer; so scenes that do well without never have them.

    Args:
        share: of the opacity that pictures need, in (0, 1), above which what is lacking makes the volumes join.
        begin: progress of training, in [0, 1], from which it is looked at; never before all frames are in.
        end: progress after which it is not looked at any more.
        every: steps between looks.
        min_steps: before which it is not looked at either: so early no model has found what it will find. A training
            that is past `end` by then does without volumes.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self, share: float = 0.06, *, begin: float = 0.35, end: float = 0.6, every: int = 8, min_steps: int = 200
    ) -> None:
        check_positive("share", share)
        check_positive("begin", begin, allow_zero=True)
        check_positive("every", every)
        check_positive("min_steps", min_steps, allow_zero=True)
        if share >= 1:
            raise ValueError(f"share must be in (0, 1), got {share}")
        if not begin < end <= 1:
            raise ValueError(f"end must be in ({begin}, 1], above begin, got {end}")
        self.share = share
        self.begin = begin
        self.end = end
        self.every = every
        self.min_steps = min_steps

    def is_due(self, step: int, progress: float) -> bool:
        """Whether to look after a step, the `step`-th, at that progress; frames that are not in are the caller's."""
        return step >= self.min_steps and step % self.every == 0 and self.begin <= progress <= self.end

    def __call__(self, step: int, model: nn.Module, found: Mapping[str, float]) -> bool:
        """Let volumes of the model join if it lacks too much.

        Args:
            step: done.
            model: in training.
            found: of the step's batch, see `lacking_opacity`.

        Returns:
            Whether any joined: the model now takes another path.
        """
        waiting = [part for part in model.modules() if isinstance(part, SpaceTimeVolumes) and not part.has_joined]
        lacking = found[LACKING] / max(found[NEEDED], 1e-6)
        if not waiting or not lacking > self.share:
            return False
        for part in waiting:
            part.join()
        logger.info("step %d: motion does not find %.0f %% of the matter; space-time volumes join", step, 100 * lacking)
        return True
