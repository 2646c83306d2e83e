"""What a scene needs, decided part by part: from its images where they are enough, else by short trials."""

from dnerf.planning.evidence import ColorsEvidence, Evidence, Finding, MotionEvidence, SurroundingsEvidence
from dnerf.planning.parts import Part
from dnerf.planning.plan import Decision, Plan
from dnerf.planning.planner import make_plan

__all__ = [
    "ColorsEvidence", "Decision", "Evidence", "Finding", "MotionEvidence", "Part", "Plan", "SurroundingsEvidence",
    "make_plan",
]  # fmt: skip
