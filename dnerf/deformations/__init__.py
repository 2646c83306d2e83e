"""Deformations: world -> canonical."""

from dnerf.deformations.along_rays import AlongRaysDeformation, deform_along_rays
from dnerf.deformations.base import Deformation, IdentityDeformation, InvertibleDeformation, unwrapped
from dnerf.deformations.cached import CachedAtTime, CachedDeformation
from dnerf.deformations.displacement import DisplacementDeformation, SE3Deformation
from dnerf.deformations.flow import FlowChain, FlowDeformation
from dnerf.deformations.inversion import invert
from dnerf.deformations.solvers import IntegrationError

__all__ = [
    "AlongRaysDeformation", "CachedAtTime", "CachedDeformation", "Deformation", "DisplacementDeformation", "FlowChain",
    "FlowDeformation", "IdentityDeformation", "IntegrationError", "InvertibleDeformation", "SE3Deformation",
    "deform_along_rays", "invert", "unwrapped",
]  # fmt: skip
