"""Samplers: where along the rays the field is evaluated."""

from dnerf.samplers.base import Capacity, FixedCapacity, FrontToBack, OccupancyAware, OccupiedCells, Sampler
from dnerf.samplers.importance import ImportanceSampler
from dnerf.samplers.inverse_cdf import sample_piecewise_constant
from dnerf.samplers.occupancy import OccupancySampler
from dnerf.samplers.occupancy_grid import OccupancyGrid
from dnerf.samplers.proposal import ProposalSampler, outer_bound
from dnerf.samplers.sphere_tracing import SphereTracingSampler
from dnerf.samplers.stratified import StratifiedSampler

__all__ = [
    "Capacity", "FixedCapacity", "FrontToBack", "ImportanceSampler", "OccupancyAware", "OccupancyGrid",
    "OccupancySampler", "OccupiedCells", "ProposalSampler", "Sampler", "SphereTracingSampler", "StratifiedSampler",
    "outer_bound", "sample_piecewise_constant",
]  # fmt: skip
