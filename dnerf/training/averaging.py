"""Weights averaged over the last steps, as what training leaves."""

import torch
from torch import Tensor

from dnerf.core.checks import check_positive, check_whole
from dnerf.training.run import Callback, Run


class WeightAverage(Callback):
    """Ends training with a running mean of the weights instead of the last ones, which the last batches pull about.

    At step s the mean keeps (r / s)^(1 / span) of what it was at its last look, step r. So it reaches over a share
    `span` of all steps done, however many these are, and forgets what was before; also in a run that is continued.

    Sources: Polyak and Juditsky 1992; the power of s instead of an exponential is that of Karras et al. 2024
    (arXiv 2312.02696) section 3.1, with gamma = 1 / span - 1.

    Args:
        span: of the steps, > 0.
        every: steps between looks at the weights.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(self, span: float = 0.05, *, every: int = 4) -> None:
        check_positive("span", span)
        check_whole("every", every)
        self.span, self.every = span, every
        self._means: dict[str, Tensor] = {}
        self._step = torch.zeros((), dtype=torch.int64)  # of the last look
        self._generation = 0

    def on_train_begin(self, run: Run) -> None:
        """Forget earlier runs."""
        self._means = {name: x.detach().clone() for name, x in run.renderer.named_parameters()}
        self._step.fill_(run.step)
        self._generation = run.renderer.generation

    @torch.no_grad()
    def on_step_end(self, run: Run) -> None:
        """Look at the weights; begin anew where the model was changed from outside, as by a rollback."""
        is_new = self._generation != run.renderer.generation
        if run.step % self.every and not run.ends and not is_new:
            return
        weights, means = [x.detach() for x in run.renderer.parameters()], list(self._means.values())
        if is_new:
            torch._foreach_copy_(means, weights)  # what was there may be no numbers
        else:
            kept = (int(self._step) / run.step) ** (1 / self.span)
            torch._foreach_lerp_(means, weights, 1 - kept)
        self._step.fill_(run.step)
        self._generation = run.renderer.generation

    @torch.no_grad()
    def on_train_end(self, run: Run) -> None:
        """Put the mean in place of the weights."""
        for name, parameter in run.renderer.named_parameters():
            parameter.copy_(self._means[name])
        run.renderer.invalidate()

    def state_dict(self) -> dict[str, Tensor]:
        """The mean, and the step of the last look."""
        return {"step": self._step, **{f"mean.{name}": x for name, x in self._means.items()}}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on averaging."""
        self._step.copy_(state["step"])
        for name, mean in self._means.items():
            mean.copy_(state[f"mean.{name}"])
