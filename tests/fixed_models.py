"""A small model of the fast path, for tests of what has a fixed size."""

import torch
from reference import occupancy_sampler

from dnerf.core.backgrounds import RandomBackground
from dnerf.core.schedules import Fade
from dnerf.deformations import DisplacementDeformation
from dnerf.fields import DeformedField, GridField, PlaneFeatures
from dnerf.losses import (
    AppearanceConstancyLoss,
    ElasticLoss,
    JacobianDeterminantLoss,
    Loss,
    PhotometricLoss,
    UnseenSpaceLoss,
)
from dnerf.rendering.renderer import Renderer

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))


def small_renderer(*, graphs: bool = False, device: str = "cpu", **sampling: object) -> Renderer:
    """Deformation, grid and occupancy in a size that trains in no time."""
    torch.manual_seed(0)
    planes = PlaneFeatures(BOX, (8,), 4)
    field = DeformedField(
        DisplacementDeformation(2, 32, (), position_frequencies=2, time_frequencies=2),
        GridField(BOX, (8, 16), 4, hidden_features=32, temporal_terms=2, window_end=0.4, space_time=planes),
    )
    options = {
        "num_probes": 512, "min_weight": 1e-4, "subdivision_weight": 0.02, "subdivision": 2, "pad_to": 1, **sampling
    }  # fmt: skip
    sampler = occupancy_sampler(BOX, 0.1, 16, **options)
    return Renderer(field, sampler, RandomBackground(), stop_transmittance=1e-3, graphs=graphs).to(device)


def losses() -> dict[str, Loss]:
    """One of each kind that the fast path or its flow has; some every few steps, one of a weight that fades."""
    return {
        "rgb": PhotometricLoss(),
        "elastic": ElasticLoss(every=2),
        "jacobian": JacobianDeterminantLoss(Fade(1e-2)),
        "appearance": AppearanceConstancyLoss(every=4),
        "unseen_space": UnseenSpaceLoss(BOX, memory_samples=200, every=4),
    }
