"""How close images, films and motions are to the truth, and how consistent they are over time."""

from dnerf.evaluation.consistency import Finding, check_consistency
from dnerf.evaluation.error_kinds import error_shares, kinds_of
from dnerf.evaluation.images import lpips_metric, psnr, ssim
from dnerf.evaluation.motion import TrackErrors, end_point_error, flow_outliers, track_errors
from dnerf.evaluation.scores import Evaluation, FrameScore, evaluate, scores_by_time, spread_indices
from dnerf.evaluation.temporal import TemporalScores, evaluate_over_time
from dnerf.evaluation.temporal_metrics import depth_consistency, flicker, sample_image, temporal_psnr, warping_error

__all__ = [
    "Evaluation", "Finding", "FrameScore", "TemporalScores", "TrackErrors", "check_consistency", "depth_consistency",
    "end_point_error", "error_shares", "evaluate", "evaluate_over_time", "flicker", "flow_outliers", "kinds_of",
    "lpips_metric", "psnr", "sample_image", "scores_by_time", "spread_indices", "ssim", "temporal_psnr", "track_errors",
    "warping_error",
]  # fmt: skip
