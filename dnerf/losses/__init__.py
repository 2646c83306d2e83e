"""Training losses: each looks at a rendering, its batch and the model, and returns one number."""

from dnerf.losses.base import Batch, Loss
from dnerf.losses.deformation import AppearanceConstancyLoss, ElasticLoss, JacobianDeterminantLoss, RestLoss
from dnerf.losses.histogram import HistogramLoss
from dnerf.losses.photometric import PhotometricLoss
from dnerf.losses.regularizers import DistortionLoss, EikonalLoss, SmoothnessLoss, TimeEmbeddingLoss, UnseenSpaceLoss

__all__ = [
    "AppearanceConstancyLoss", "Batch", "DistortionLoss", "EikonalLoss", "ElasticLoss", "HistogramLoss",
    "JacobianDeterminantLoss", "Loss", "PhotometricLoss", "RestLoss", "SmoothnessLoss", "TimeEmbeddingLoss",
    "UnseenSpaceLoss",
]  # fmt: skip
