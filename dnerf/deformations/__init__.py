"""Deformations: world -> canonical."""

from dnerf.deformations.base import Deformation, IdentityDeformation, InvertibleDeformation, unwrapped
from dnerf.deformations.cached import CachedAtTime, CachedDeformation
from dnerf.deformations.displacement import DisplacementDeformation, SE3Deformation
from dnerf.deformations.flow import FlowChain, FlowDeformation
from dnerf.deformations.inversion import invert
from dnerf.deformations.solvers import IntegrationError

__all__ = [
    "CachedAtTime", "CachedDeformation", "Deformation", "DisplacementDeformation", "FlowChain",
    "FlowDeformation", "IdentityDeformation", "IntegrationError", "InvertibleDeformation", "SE3Deformation",
    "invert", "unwrapped",
]  # fmt: skip
