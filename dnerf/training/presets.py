"""Plain Python for what `conf/experiment/fast.yaml` composes: a model, its trainer, and frames to train on."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from torch import Tensor

from dnerf.core.backgrounds import Background, RandomBackground
from dnerf.core.checks import as_box
from dnerf.core.schedules import Ramp
from dnerf.data.folder import FolderData
from dnerf.data.frames import Frames
from dnerf.data.pixel_samplers import ErrorGuidedPixels, TemporalCurriculum
from dnerf.deformations import CachedDeformation, Deformation, DisplacementDeformation
from dnerf.fields import DeformedField, GridField, RadianceField
from dnerf.losses import AppearanceConstancyLoss, ElasticLoss, PhotometricLoss, TimeEmbeddingLoss, UnseenSpaceLoss
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import OccupancyGrid, OccupancySampler
from dnerf.training.averaging import WeightAverage
from dnerf.training.callbacks import ProgressBar
from dnerf.training.optimizer import AdamSettings
from dnerf.training.recovery import Recovery
from dnerf.training.run import Callback
from dnerf.training.trainer import Trainer

Corners = Tensor | Sequence[Sequence[float]]


def load_dataset(path: str | Path, split: str = "train", resolution: int | None = None) -> Frames:
    """Frames of a data set's folder, of any format that is read, in world units: see `FolderData` for more.

    Args:
        path: of the folder.
        split: "train", "val" or "test".
        resolution: width in pixels after area averaging; None keeps the files' size, at most 400.

    Raises:
        ValueError: naming the file that is missing or broken.
    """
    return FolderData(path, resolution).frames(split)


def make_renderer(
    box: Corners, *, deformation: Deformation | None = None, field: RadianceField | None = None,
    background: Background | None = None,
) -> Renderer:  # fmt: skip
    """The model of `experiment=fast`: a small displacement network into a multi-resolution grid.

    Args:
        box: (2, 3) corners of what is modelled, in world units, see `fit_box`.
        deformation: world -> canonical, in place of the displacement network.
        field: canonical, in place of the grid.
        background: any colour in training, white in images if None, which needs frames with alpha.

    Raises:
        ValueError: for a box that is none.
    """
    corners = as_box(box).tolist()
    if deformation is None:
        deformation = DisplacementDeformation(
            4, 128, position_frequencies=3, time_frequencies=5, canonical_time=None, time_embeddings=100
        )
    if field is None:
        field = GridField(corners, (16, 32, 64, 128, 256), temporal_terms=4, window_end=0.3)
    sampler = OccupancySampler(
        OccupancyGrid(corners, 64, decay=0.6, render_dilation=0),
        Ramp(0.04, 0.028, end=0.5, kind="exponential"),
        subdivision=2, render_subdivision=3, subdivision_weight=0.02, narrow_from=0.3, min_weight=1e-4,
        chance_weight=0.02,
    )  # fmt: skip
    return Renderer(
        DeformedField(CachedDeformation(deformation, corners, spacing=0.05), field), sampler,
        RandomBackground("white") if background is None else background, precision="bfloat16", stop_transmittance=4e-3,
    )  # fmt: skip


def make_trainer(
    *, max_seconds: float | None = None, num_steps: int = 200_000, callbacks: Mapping[str, Callback] | None = None,
) -> Trainer:  # fmt: skip
    """The trainer of `experiment=fast`, for a renderer of `make_renderer`.

    A term that another model cannot have may be taken out before training: `del trainer.losses["time_embedding"]`.

    Args:
        max_seconds: most seconds of training, or None.
        num_steps: most steps.
        callbacks: by name; recovery, a progress bar and averaged weights if None.

    Raises:
        ValueError: for numbers out of range.
    """
    losses = {
        "rgb": PhotometricLoss(), "elastic": ElasticLoss(), "appearance_constancy": AppearanceConstancyLoss(),
        "unseen_space": UnseenSpaceLoss(), "time_embedding": TimeEmbeddingLoss(),
    }  # fmt: skip
    optimizer = AdamSettings(
        {"default": 2e-2, "deformation": 6e-3, "deformation_output": 1.5e-3, "head": 5e-3},
        weight_decays={"features": 1e-8}, final_rate=0.05, hold_until=0.3, warmup_steps=20, betas=(0.9, 0.99),
        epsilon=1e-15, orthogonal=True,
    )  # fmt: skip
    if callbacks is None:
        callbacks = {"recovery": Recovery(), "progress_bar": ProgressBar(), "weight_average": WeightAverage()}
    return Trainer(
        num_steps=num_steps, max_seconds=max_seconds, opening_steps=1500, num_rays=256, max_rays=16384,
        target_samples=15360, losses=losses, pixels=ErrorGuidedPixels(TemporalCurriculum(0.3)), optimizer=optimizer,
        callbacks=callbacks,
    )  # fmt: skip
