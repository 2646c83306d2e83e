"""Velocity fields for flows."""

from dnerf.deformations.velocities.base import BoxWindow, Velocity
from dnerf.deformations.velocities.network import NetworkVelocity

__all__ = ["BoxWindow", "NetworkVelocity", "Velocity"]
