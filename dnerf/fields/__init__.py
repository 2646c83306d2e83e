"""Radiance fields: density and colour at positions, directions and times."""

from dnerf.core.compositing import FieldOutput
from dnerf.fields.base import (
    HasRoughness,
    IntervalAware,
    NetworkTabled,
    RadianceField,
    SignedDistance,
    TimeDependence,
    evaluate_along_rays,
)
from dnerf.fields.deformed import CachedField, DeformedField
from dnerf.fields.grid import GridField
from dnerf.fields.nerf import NeRFField
from dnerf.fields.space_time import SpaceTimeVolumes
from dnerf.fields.surroundings import Surroundings
from dnerf.fields.voxels import VoxelField

__all__ = [
    "CachedField", "DeformedField", "FieldOutput", "GridField", "HasRoughness", "IntervalAware", "NeRFField",
    "NetworkTabled", "RadianceField", "SignedDistance", "SpaceTimeVolumes", "Surroundings", "TimeDependence",
    "VoxelField", "evaluate_along_rays",
]  # fmt: skip
