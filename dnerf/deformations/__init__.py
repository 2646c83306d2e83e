"""Deformations: world -> canonical."""

from dnerf.deformations.base import Deformation, InvertibleDeformation
from dnerf.deformations.displacement import DisplacementDeformation
from dnerf.deformations.identity import IdentityDeformation

__all__ = ["Deformation", "DisplacementDeformation", "IdentityDeformation", "InvertibleDeformation"]
