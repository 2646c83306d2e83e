"""Radiance fields: density and colour at positions, directions and times."""

from dnerf.core.compositing import FieldOutput
from dnerf.fields.ambient import AmbientCoordinates
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
from dnerf.fields.planes import PlaneFeatures, PlanesField
from dnerf.fields.sdf import NeuSField, SDFField, VolSDFField
from dnerf.fields.surroundings import SurroundingsBackground
from dnerf.fields.voxels import VoxelField

__all__ = [
    "AmbientCoordinates", "CachedField", "DeformedField", "FieldOutput", "GridField", "HasRoughness", "IntervalAware",
    "NeRFField", "NetworkTabled", "NeuSField", "NormalField", "PlaneFeatures", "PlanesField", "RadianceField",
    "SDFField", "SignedDistance", "SurroundingsBackground", "TimeDependence", "VolSDFField", "VoxelField",
    "evaluate_along_rays", "normals",
]  # fmt: skip
