"""Runs that go wrong: not-a-numbers and collapse to the background are noticed, told, and taken back."""

import copy
import logging
from collections import deque
from typing import Any

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_whole
from dnerf.training.records import TrainingRecord, not_finite
from dnerf.training.run import Callback, Run

logger = logging.getLogger(__name__)


# Mean opacity of a batch below which it shows nothing but background; a collapse if its images differ from that by more
# than ten times as much on average.
MIN_OPACITY = 1e-3


class Recovery(Callback):
    """Watches a training run and brings it back.

    Its state (parameters, buffers, optimiser) is copied in memory every so many steps, as long as the run is healthy.
    When it breaks, the last good copy comes back and training goes on with smaller steps.

    Args:
        max_rollbacks: how often a run may be brought back; 0 ends it at the first failure.
        learning_rate_factor: on all learning rates after every rollback, in (0, 1).
        keep_every: steps between copies of the state.
        patience: records in a row that must show nothing but background before that counts as a collapse.

    Raises:
        ValueError: for numbers out of range.
    """

    handles_failures = True

    def __init__(
        self, max_rollbacks: int = 3, learning_rate_factor: float = 0.3, *, keep_every: int = 100, patience: int = 5
    ) -> None:
        check_whole("max_rollbacks", max_rollbacks, allow_zero=True)
        check_whole("keep_every", keep_every)
        check_whole("patience", patience)
        if not 0 < learning_rate_factor < 1:
            raise ValueError(f"learning_rate_factor must be in (0, 1), got {learning_rate_factor}")
        self.max_rollbacks, self.learning_rate_factor = max_rollbacks, learning_rate_factor
        self.keep_every, self.patience, self.rollbacks = keep_every, patience, 0

    def on_train_begin(self, run: Run) -> None:
        """Forget earlier runs."""
        self.rollbacks = 0
        self.failures: list[str] = []
        self._good: tuple[int, dict[str, Tensor], dict[str, Any]] | None = None
        self._empty: deque[bool] = deque(maxlen=self.patience)
        self._step_kept = -self.keep_every

    def state_dict(self) -> dict[str, Tensor]:
        """How often the run has been brought back."""
        return {"rollbacks": torch.tensor(self.rollbacks)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on counting, with learning rates as they were."""
        self.rollbacks = int(state["rollbacks"])

    def on_step_begin(self, run: Run) -> None:
        """Set the learning rates' factor after the rollbacks so far."""
        run.rate_factor = self.learning_rate_factor**self.rollbacks

    def on_step_end(self, run: Run) -> None:
        """Look at a record: keep the run's state if it is healthy, roll it back if it is not.

        Raises:
            FloatingPointError: if something went wrong and no rollback is left.
        """
        record, model = run.record, run.renderer
        if record is None:
            return
        failure = self._find(record, model)
        if failure is None:
            # A batch that shows nothing may be the first of a collapse.
            if record.step - self._step_kept >= self.keep_every and not any(self._empty):
                weights = {name: value.detach().clone() for name, value in model.state_dict().items()}
                self._good = (record.step, weights, copy.deepcopy(run.optimizer.state_dict()))
                self._step_kept = record.step
            return
        if self._good is None or self.rollbacks >= self.max_rollbacks:
            raise FloatingPointError(f"{failure}; {self.rollbacks} rollbacks did not help")
        self.failures.append(failure)
        self.rollbacks += 1
        good_step, weights, moments = self._good
        model.load_state_dict(weights)
        run.optimizer.load_state_dict(copy.deepcopy(moments))
        model.invalidate()
        self._empty.clear()
        self._step_kept = record.step
        run.take_back()
        logger.warning(
            "%s; back to the state of step %d, learning rates now %.3g of the schedule's (rollback %d of %d)",
            failure, good_step, self.learning_rate_factor**self.rollbacks, self.rollbacks, self.max_rollbacks,
        )  # fmt: skip

    def _find(self, record: TrainingRecord, model: nn.Module) -> str | None:
        """What went wrong, the likely cause, and what helps; None if nothing did."""
        parameters, gradients = not_finite(model), not_finite(model, gradients=True)
        found = {"losses": record.broken(), "parameters": parameters, "gradients": gradients}
        what = ", ".join(f"{kind} not finite: {', '.join(names[:3])}" for kind, names in found.items() if names)
        if parameters:
            cause = f"a step that was too large, first seen in {parameters[0]}; lower its learning rate"
        elif gradients:
            cause = f"a gradient that overflows, first seen in {gradients[0]}; lower its learning rate"
        elif what:
            cause = "a value that overflows in the forward pass or a target that is not finite; check the data"
        else:
            self._empty.append(record.opacity < MIN_OPACITY and record.contrast > 10 * MIN_OPACITY)
            if len(self._empty) < self.patience or not all(self._empty):
                return None
            what = (
                f"images are all background in {self.patience} records in a row (mean opacity {record.opacity:.1e}, "
                f"while they should differ from it by {record.contrast:.2f})"
            )
            cause = (
                "steps too large early on, or density that starts too thin; lower the learning rate, raise "
                "warmup_steps or density_shift"
            )
        return f"step {record.step}: {what}; likely cause: {cause}"
