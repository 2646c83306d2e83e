"""A person's own film in, a data set out: sharp frames, the cameras that took them, and what to film instead."""

from dnerf.capturing.data_set import capture
from dnerf.capturing.frames import find_films
from dnerf.capturing.structure import StructureSettings

__all__ = ["StructureSettings", "capture", "find_films"]
