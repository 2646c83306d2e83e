"""Velocity fields for flows."""

from dnerf.deformations.velocities.base import BoxWindow, Velocity
from dnerf.deformations.velocities.curl import CurlVelocity
from dnerf.deformations.velocities.network import NetworkVelocity
from dnerf.deformations.velocities.rigid import RigidVelocity

__all__ = ["BoxWindow", "CurlVelocity", "NetworkVelocity", "RigidVelocity", "Velocity"]
