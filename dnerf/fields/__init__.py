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
from dnerf.fields.normals import NormalField, normals
from dnerf.fields.sdf import NeuSField, SDFField, VolSDFField
from dnerf.fields.space_time import SpaceTimeVolumes
from dnerf.fields.surroundings import Surroundings

__all__ = [
    "CachedField", "DeformedField", "FieldOutput", "GridField", "HasRoughness", "IntervalAware", "NeRFField",
    "NetworkTabled", "NeuSField", "NormalField", "RadianceField", "SDFField", "SignedDistance", "SpaceTimeVolumes",
    "Surroundings", "TimeDependence", "VolSDFField", "evaluate_along_rays", "normals",
]  # fmt: skip
