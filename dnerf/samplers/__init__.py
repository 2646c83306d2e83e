"""Samplers: where along the rays the field is evaluated."""

from dnerf.samplers.base import Sampler
from dnerf.samplers.importance import ImportanceSampler
from dnerf.samplers.inverse_cdf import sample_piecewise_constant
from dnerf.samplers.occupancy import OccupancySampler
from dnerf.samplers.stratified import StratifiedSampler

__all__ = ["ImportanceSampler", "OccupancySampler", "Sampler", "StratifiedSampler", "sample_piecewise_constant"]
