"""A part of the model that a scene may or may not need, and the candidates for it."""

from collections.abc import Mapping, Sequence

from dnerf.core.checks import check_choice
from dnerf.planning.evidence import Evidence


class Part:
    """One question about a scene, and the ways in which a model can answer it.

    Args:
        question: in a few words, for the table of decisions.
        candidates: from the simplest to the richest; by name, the overrides of the config that make it. The first word
            of `plan.<part>=true` is the second candidate, of `false` the first.
        default: name of the candidate that stands until another one is better.
        at: progress of training, in (0, 1), at which candidates are tried against each other, from the same weights.
        evidence: looks at the images before training; None where they cannot be enough.
        only_if: choices of earlier parts, by their names, without which the question does not arise.
        first: the one with which a model takes its first steps, and stays where these are all; the default if None.

    Raises:
        ValueError: for fewer than two candidates, an unknown default, or a progress out of range.
    """

    def __init__(
        self, question: str, candidates: Mapping[str, Sequence[str]], default: str, *, at: float = 0.1,
        evidence: Evidence | None = None, only_if: Mapping[str, str] | None = None, first: str | None = None,
    ) -> None:  # fmt: skip
        if len(candidates) < 2:
            raise ValueError(f"candidates must be at least two, got {list(candidates)}")
        self.first = default if first is None else first
        for name, choice in (("default", default), ("first", self.first)):
            check_choice(name, choice, tuple(candidates))
        if not 0 < at < 1:
            raise ValueError(f"at must be in (0, 1), got {at}")
        self.question, self.default, self.at, self.evidence = question, default, at, evidence
        self.candidates = {name: tuple(overrides) for name, overrides in candidates.items()}
        self.only_if = dict(only_if or {})
        self.simplest = next(iter(self.candidates))
        # What a model has that none of the candidates' settings fit.
        self.unchanged = next((name for name, overrides in self.candidates.items() if not overrides), default)

    def arises(self, choices: Mapping[str, str]) -> bool:
        """Whether the choices made so far leave the question open."""
        return all(choices.get(name) == choice for name, choice in self.only_if.items())

    def named(self, part: str, choice: object) -> str:
        """The candidate that a setting means: its name, or true or false; ValueError for any other."""
        names = tuple(self.candidates)
        if isinstance(choice, bool):
            return names[1] if choice else names[0]
        if choice not in names:
            raise ValueError(f"plan.{part} must be one of {', '.join(names)}, true, false or null, got {choice!r}")
        return str(choice)
