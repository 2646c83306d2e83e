"""Radiance fields: density and colour at positions, directions and times."""

from dnerf.compositing import FieldOutput
from dnerf.fields.baked import BakedField, Baking
from dnerf.fields.base import RadianceField
from dnerf.fields.deformed import DeformedField
from dnerf.fields.grid import GridField
from dnerf.fields.nerf import NeRFField
from dnerf.fields.space_time import SpaceTimeVolumes

__all__ = [
    "BakedField", "Baking", "DeformedField", "FieldOutput", "GridField", "NeRFField", "RadianceField",
    "SpaceTimeVolumes",
]  # fmt: skip
