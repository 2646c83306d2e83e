"""Deciding what a scene needs: settings, then images, then trials, for at most a share of the training's budget."""

import math
import time
from collections.abc import Mapping

from torch import Tensor

from dnerf.data.frames import Frames
from dnerf.planning.evidence import Finding
from dnerf.planning.parts import Part
from dnerf.planning.plan import AS_SET, Decision, Plan, fingerprint
from dnerf.planning.trials import Contender, Effort, HeldOut, Maker, contest, split_frames
from dnerf.training.callbacks import Callback
from dnerf.training.run import Run

LEAST_STEPS = 48  # of a trial: fewer cost a short training more than they tell
LEAST_DONE = 64  # steps of a model before its parts are tried: what helps a fresh one may not help for long
MOST_STEPS = 400  # more tell nothing new


def make_plan(
    parts: Mapping[str, Part], given: Mapping[str, str], make: Maker, frames: Frames, box: Tensor, *, seed: int = 0,
    share: float = 0.1, callbacks: Mapping[str, Callback] | None = None,
) -> tuple[Plan, Run | None]:  # fmt: skip
    """Decide every part, and the run that the trials' winner has begun.

    Parts are decided one after the other, in the order of when they are tried. Candidates go on from the weights of the
    model decided so far, train for the same time (or steps, if those end training), and are compared on held-out
    frames; the loser's time counts as training time. All of it takes at most a share of the budget.

    Args:
        parts: by name.
        given: choices that stand already, by part.
        make: builds model and trainer for choices by part.
        frames: the training split.
        box: (2, 3) corners of what is modelled.
        seed: of the trials' draws.
        share: of the training's seconds, or steps, for trials.
        callbacks: around the steps of the model that stands, until it is the final one; none if None.

    Returns:
        plan: decisions for all parts.
        run: of the model that `make` builds for them, some steps in; None if no trial was needed.
    """
    return _Planner(parts, given, make, frames, box, seed, share, callbacks or {}).decide()


class _Planner:
    def __init__(
        self, parts: Mapping[str, Part], given: Mapping[str, str], make: Maker, frames: Frames, box: Tensor,
        seed: int, share: float, callbacks: Mapping[str, Callback],
    ) -> None:  # fmt: skip
        self.parts, self.make, self.frames, self.seed, self.share = parts, make, frames, seed, share
        self.callbacks, self.box = callbacks, box.to(frames.poses)
        self.lost_steps = 0  # of all losers
        self.decisions: dict[str, Decision] = {}
        self.standing = {name: Finding(part.default, "") for name, part in parts.items()}
        self.leading: Contender | None = None
        order = sorted(parts, key=lambda name: parts[name].at)
        for name in order:
            self._without_training(name, given.get(name))
        self.tried = [name for name in order if name not in self.decisions]

    def _without_training(self, name: str, given: str | None) -> None:
        part = self.parts[name]
        begin = time.perf_counter()
        if given is not None:
            self.decisions[name] = Decision(given, "given", self._as_set(part, given))
        elif not part.arises(self._choices()):
            self.decisions[name] = Decision(part.simplest, "default", "the question does not arise")
        elif part.evidence is not None and (finding := part.evidence.find(self.frames, self.box)) is not None:
            seconds = time.perf_counter() - begin
            if finding.is_certain:
                self.decisions[name] = Decision(finding.choice, "images", finding.why, seconds=seconds)
            else:
                self.standing[name] = finding

    def _as_set(self, part: Part, given: str) -> str:
        """Why a given choice stands, with what speaks against it."""
        if given != part.simplest and not part.arises(self._choices()):
            needed = ", ".join(f"{name}={choice}" for name, choice in part.only_if.items())
            return f"{AS_SET}, though the question arises with {needed} only"
        finding = None if part.evidence is None else part.evidence.find(self.frames, self.box)
        return AS_SET if finding is None or finding.choice == given else f"{AS_SET}, though {finding.why}"

    def _choices(self, **tried: str) -> dict[str, str]:
        """Those made or tried, defaults for all others, the simplest where a question does not arise."""
        choices = {name: finding.choice for name, finding in self.standing.items()}
        choices |= {name: decision.choice for name, decision in self.decisions.items()} | tried
        for name, part in self.parts.items():
            if name not in self.decisions and not part.arises(choices):
                choices[name] = part.simplest
        return choices

    def decide(self) -> tuple[Plan, Run | None]:
        """See `make_plan`."""
        halves = split_frames(self.frames)
        for number, name in enumerate(self.tried):
            part = self.parts[name]
            if not part.arises(self._choices()):
                self.decisions[name] = Decision(part.simplest, "default", "the question does not arise")
            elif halves is None:
                self.decisions[name] = self._untried(name, f"{len(self.frames)} frames are too few to try")
            else:
                self._try(name, *halves, num_left=len(self.tried) - number)
        if self.leading is not None:
            for callback in self.callbacks.values():
                callback.on_train_end(self.leading.run)
            self.leading.run.callbacks = {}
        plan = Plan({name: self.decisions[name] for name in self.parts}, fingerprint(self.frames))
        return plan, None if self.leading is None else self.leading.run

    def _try(self, name: str, learnt: Frames, held: Frames, num_left: int) -> None:
        part, standing = self.parts[name], self.standing[name].choice
        leading = self._leading(learnt, self._choices(), part.at)
        effort = self._effort(leading, len(part.candidates) - 1, num_left)
        if effort.num_steps >= LEAST_STEPS:  # else stop at once: frames would be held out in vain
            self._advance(leading, part.at)
            effort = self._effort(leading, len(part.candidates) - 1, num_left)
        if effort.num_steps < LEAST_STEPS or leading.run.step < LEAST_DONE:
            self.decisions[name] = self._untried(name, "the budget is too small to try")
            return
        others = [choice for choice in part.candidates if choice != standing]
        leading.choice = standing
        forked = (leading.forked(c, self.make, self._choices(**{name: c}), learnt, self.seed) for c in others)
        contenders = [leading, *forked]
        before, first = [contender.run.seconds for contender in contenders], leading.run.step
        result = contest(contenders, HeldOut.of(held, self.seed), effort)
        winner = result.winner
        losers = [(c, seconds) for c, seconds in zip(contenders, before, strict=True) if c is not winner]
        lost = result.seconds + sum(loser.run.seconds - seconds for loser, seconds in losers)
        self.lost_steps += sum(loser.run.step - first for loser, _ in losers)
        second = "the others" if len(losers) > 1 else losers[0][0].choice
        why = f"{effort.num_steps} steps, on held-out pixels, against {second}"
        finite = {"gain": result.gain, "error": result.error} if math.isfinite(result.gain + result.error) else {}
        self.decisions[name] = Decision(winner.choice, "trial", why, seconds=lost, **finite)
        winner.run.seconds += lost
        winner.run.callbacks = leading.run.callbacks
        self.leading = winner

    def _untried(self, name: str, why: str) -> Decision:
        standing = self.standing[name]
        if standing.why:
            return Decision(standing.choice, "images", f"{standing.why}; {why}")
        part, is_first = self.parts[name], self.leading is not None and self.leading.run.step < LEAST_DONE
        return Decision(part.first if is_first else part.default, "default", why)

    def _leading(self, learnt: Frames, choices: Mapping[str, str], at: float) -> Contender:
        """The model decided so far, after first steps of parts' first candidates, at most until a progress."""
        undecided = {n: p for n, p in self.parts.items() if n not in self.decisions and choices[n] == p.default}
        first = {**choices, **{name: part.first for name, part in undecided.items()}}
        if self.leading is None:
            self.leading = Contender.fresh("", self.make, first, learnt, self.seed)
            self.leading.run.callbacks = self.callbacks
            for callback in self.callbacks.values():
                callback.on_train_begin(self.leading.run)
        if self.leading.run.step < LEAST_DONE:
            self._advance(self.leading, at, LEAST_DONE)
            if first != choices and self.leading.run.step >= LEAST_DONE:
                self.leading = self.leading.forked("", self.make, choices, learnt, self.seed)
                self.leading.run.callbacks = self.callbacks
        return self.leading

    def _advance(self, leading: Contender, at: float, step: float = math.inf) -> None:
        run, limits = leading.run, leading.trainer.limits
        leading.trainer.advance(run, lambda: run.step >= step or limits.progress(run.step, run.seconds) >= at)

    def _effort(self, leading: Contender, num_others: int, num_left: int) -> Effort:
        """What each candidate may spend for the budget's share to suffice."""
        limits, run = leading.trainer.limits, leading.run
        if limits.max_seconds is None:
            left = self.share * limits.num_steps - self.lost_steps
            return Effort(min(int(left / num_left / num_others), MOST_STEPS), 0.0)
        each = run.seconds / run.step
        spent = sum(decision.seconds for decision in self.decisions.values() if decision.by == "trial")
        budget = (self.share * limits.max_seconds - spent) / num_left
        num_steps = min(int(budget / num_others / each), MOST_STEPS)
        return Effort(num_steps, num_steps * each)
