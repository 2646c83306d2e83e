"""Deformations: world -> canonical."""

from dnerf.deformations.base import Deformation, InvertibleDeformation
from dnerf.deformations.displacement import DisplacementDeformation
from dnerf.deformations.fixed_point import invert
from dnerf.deformations.flow import FlowDeformation
from dnerf.deformations.identity import IdentityDeformation
from dnerf.deformations.solvers import IntegrationError

__all__ = [
    "Deformation",
    "DisplacementDeformation",
    "FlowDeformation",
    "IdentityDeformation",
    "IntegrationError",
    "InvertibleDeformation",
    "invert",
]
