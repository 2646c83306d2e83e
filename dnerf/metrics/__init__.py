"""How close pictures, sequences and motions are to the truth."""

from dnerf.metrics.images import psnr, ssim
from dnerf.metrics.motion import (
    TrackErrors,
    end_point_error,
    flow_outliers,
    scene_flow_accuracy,
    track_errors,
)
from dnerf.metrics.temporal import depth_consistency, flicker, sample_picture, temporal_psnr, warping_error

__all__ = [
    "TrackErrors",
    "depth_consistency",
    "end_point_error",
    "flicker",
    "flow_outliers",
    "psnr",
    "sample_picture",
    "scene_flow_accuracy",
    "ssim",
    "temporal_psnr",
    "track_errors",
    "warping_error",
]
