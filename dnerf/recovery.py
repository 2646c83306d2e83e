"""Runs that go wrong: not-a-numbers and collapse to the background are noticed, told, and taken back.

The state of a training run (parameters, buffers, optimiser) is copied in memory every so many steps, as long as the
run is healthy. When it breaks, the last good copy comes back and training goes on with smaller steps, at most a stated
number of times; then the run ends with an error that says what happened.
"""

import copy
import logging
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from dnerf.checks import check_positive
from dnerf.compositing import Rendering

logger = logging.getLogger(__name__)


SHOWN = ("mean opacity", "mean contrast")


def what_is_shown(rendering: Rendering, target: Tensor) -> dict[str, Tensor]:
    """How much a batch shows and ought to show; nothing is computed that waits for a device.

    Args:
        rendering: of the batch, with its background.
        target: (R, 3) true colours on the same background.

    Returns:
        Two scalars named as in `SHOWN`: mean opacity, and mean largest difference of the truth from the background.
    """
    background = 0.0 if rendering.background is None else rendering.background
    contrast = (target - background).detach().abs().amax(-1)
    means = (rendering.mean(values) for values in (rendering.opacity.detach(), contrast))
    return dict(zip(SHOWN, means, strict=True))


@dataclass(frozen=True)
class Failure:
    """What went wrong.

    Args:
        step: at which it was noticed.
        what: the tensor or loss concerned, and its state.
        cause: the likely reason, and what helps.
    """

    step: int
    what: str
    cause: str

    def __str__(self) -> str:
        return f"step {self.step}: {self.what}; likely cause: {self.cause}"


class Recovery:
    """Watches a training run and brings it back.

    Args:
        max_rollbacks: how often a run may be brought back; 0 ends it at the first failure.
        learning_rate_factor: on all learning rates after every rollback, in (0, 1).
        keep_every: steps between copies of the state.
        patience: records in a row that must show nothing but background before that counts as a collapse.
        min_opacity: mean opacity of a batch below which it shows nothing but background; a collapse if its pictures
            differ from the background by more than ten times as much on average.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self,
        max_rollbacks: int = 3,
        learning_rate_factor: float = 0.3,
        *,
        keep_every: int = 100,
        patience: int = 5,
        min_opacity: float = 1e-3,
    ) -> None:
        check_positive("max_rollbacks", max_rollbacks, allow_zero=True)
        for name, value in (("keep_every", keep_every), ("patience", patience), ("min_opacity", min_opacity)):
            check_positive(name, value)
        if not 0 < learning_rate_factor < 1:
            raise ValueError(f"learning_rate_factor must be in (0, 1), got {learning_rate_factor}")
        self.max_rollbacks = max_rollbacks
        self.learning_rate_factor = learning_rate_factor
        self.keep_every = keep_every
        self.patience = patience
        self.min_opacity = min_opacity
        self.begin()

    def begin(self, rollbacks: int = 0) -> None:
        """Forget earlier runs; `rollbacks` counts those of a run that is continued."""
        self.rollbacks = rollbacks
        self.failures: list[Failure] = []
        self._good: tuple[int, dict[str, Tensor], dict[str, Any]] | None = None
        self._empty: deque[bool] = deque(maxlen=self.patience)
        self._step_kept = -self.keep_every

    @property
    def factor(self) -> float:
        """On the learning rates, after the rollbacks so far."""
        return self.learning_rate_factor**self.rollbacks

    def check(
        self,
        step: int,
        model: nn.Module,
        optimizer: torch.optim.Optimizer,
        losses: Mapping[str, float],
        shown: Mapping[str, float] | None = None,
    ) -> Failure | None:
        """Look at a record of the run: keep its state if it is healthy, roll it back if it is not.

        Args:
            step: done so far.
            model: in training.
            optimizer: of its parameters.
            losses: of the step, by name.
            shown: of the step, as numbers, see `what_is_shown`; collapses go unnoticed without.

        Returns:
            What went wrong, if the state was rolled back; None if all is well.

        Raises:
            FloatingPointError: if something went wrong and no rollback is left.
        """
        failure = self._find(step, model, losses, shown)
        if failure is None:
            # A batch that shows nothing may be the first of a collapse.
            if step - self._step_kept >= self.keep_every and not any(self._empty):
                self._good = (step, _copied(model.state_dict()), copy.deepcopy(optimizer.state_dict()))
                self._step_kept = step
            return None
        if self._good is None or self.rollbacks >= self.max_rollbacks:
            raise FloatingPointError(f"{failure}; {self.rollbacks} rollbacks did not help")
        self.failures.append(failure)
        self.rollbacks += 1
        good_step, weights, moments = self._good
        model.load_state_dict(weights)
        optimizer.load_state_dict(copy.deepcopy(moments))
        self._empty.clear()
        self._step_kept = step
        logger.warning(
            "%s; back to the state of step %d, learning rates now %.3g of the schedule's (rollback %d of %d)",
            failure, good_step, self.factor, self.rollbacks, self.max_rollbacks,
        )  # fmt: skip
        return failure

    def _find(
        self, step: int, model: nn.Module, losses: Mapping[str, float], shown: Mapping[str, float] | None
    ) -> Failure | None:
        broken = [name for name, value in losses.items() if not math.isfinite(value)]
        parameters = [name for name, p in model.named_parameters() if not bool(torch.isfinite(p).all())]
        gradients = [
            name
            for name, p in model.named_parameters()
            if p.grad is not None and not bool(torch.isfinite(p.grad).all())
        ]
        if parameters or broken or gradients:
            return Failure(step, _describe(broken, parameters, gradients), _cause(parameters, gradients))
        if not shown:
            return None
        opacity, contrast = (shown[name] for name in SHOWN)
        self._empty.append(opacity < self.min_opacity and contrast > 10 * self.min_opacity)
        if len(self._empty) == self.patience and all(self._empty):
            return Failure(
                step,
                f"the picture is all background in {self.patience} records in a row (mean opacity {opacity:.1e}, "
                f"while pictures differ from it by {contrast:.2f})",
                "steps too large early on, or density that starts too thin; lower the learning rate, raise "
                "warmup_steps or density_shift",
            )
        return None


def _describe(losses: Sequence[str], parameters: Sequence[str], gradients: Sequence[str]) -> str:
    named = (("losses", losses), ("parameters", parameters), ("gradients", gradients))
    return ", ".join(f"{kind} not finite: {', '.join(names[:3])}" for kind, names in named if names)


def _cause(parameters: Sequence[str], gradients: Sequence[str]) -> str:
    if gradients and not parameters:
        return f"a gradient that overflows, first seen in {gradients[0]}; lower its learning rate"
    if parameters:
        return f"a step that was too large, first seen in {parameters[0]}; lower its learning rate"
    return "a value that overflows in the forward pass or a target that is not finite; check the data"


def _copied(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in state.items()}
