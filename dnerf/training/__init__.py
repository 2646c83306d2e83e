"""Training a renderer on frames."""

from dnerf.training.averaging import WeightAverage
from dnerf.training.callbacks import BoxWarning, ProgressBar
from dnerf.training.checkpoint_folder import CheckpointFolder, Checkpoints
from dnerf.training.logging import JsonLinesLog, Previews
from dnerf.training.optimizer import AdamMuon, AdamSettings
from dnerf.training.records import TrainingRecord
from dnerf.training.recovery import Recovery
from dnerf.training.run import Callback, Run
from dnerf.training.signals import TrainingStopped
from dnerf.training.trainer import Trainer

__all__ = [
    "AdamMuon", "AdamSettings", "BoxWarning", "Callback", "CheckpointFolder", "Checkpoints", "JsonLinesLog",
    "Previews", "ProgressBar", "Recovery", "Run", "Trainer", "TrainingRecord", "TrainingStopped", "WeightAverage",
]  # fmt: skip
