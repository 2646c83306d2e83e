"""Deformations: world -> canonical."""

from dnerf.deformations.along_rays import deform_along_rays
from dnerf.deformations.base import Deformation, InvertibleDeformation
from dnerf.deformations.carried_bodies import CarriedBodies, CarriedDeformation
from dnerf.deformations.displacement import DisplacementDeformation, SE3Deformation
from dnerf.deformations.fixed_point import invert
from dnerf.deformations.flow import FlowDeformation
from dnerf.deformations.flow_chain import Flow, FlowChain
from dnerf.deformations.frame_lattice import FrameLattice, FrozenDeformation
from dnerf.deformations.identity import IdentityDeformation
from dnerf.deformations.lattice_flow import LatticeFlow
from dnerf.deformations.skipping_flow import SkippingFlow
from dnerf.deformations.solvers import IntegrationError

__all__ = [
    "CarriedBodies",
    "CarriedDeformation",
    "Deformation",
    "DisplacementDeformation",
    "Flow",
    "FlowChain",
    "FlowDeformation",
    "FrameLattice",
    "FrozenDeformation",
    "IdentityDeformation",
    "IntegrationError",
    "InvertibleDeformation",
    "LatticeFlow",
    "SE3Deformation",
    "SkippingFlow",
    "deform_along_rays",
    "invert",
]
