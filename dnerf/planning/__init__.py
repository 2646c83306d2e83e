"""What a scene needs, decided part by part: from its images where they are enough, else by short trials."""

from dnerf.planning.evidence import Evidence, Finding
from dnerf.planning.parts import Part
from dnerf.planning.plan import Decision, Plan
from dnerf.planning.planner import make_plan

__all__ = ["Decision", "Evidence", "Finding", "Part", "Plan", "make_plan"]
