"""A small model of the fast path, for tests of what has a fixed size."""

import torch

from dnerf.backgrounds import RandomBackground
from dnerf.deformations import DisplacementDeformation
from dnerf.fields import DeformedField, GridField, SpaceTimeVolumes
from dnerf.losses import FadingLoss, HiddenMatterLoss, Loss, PhotometricLoss
from dnerf.motion_losses import ElasticLoss, FoldingLoss, SteadyMatterLoss, VolumeLoss
from dnerf.renderer import Renderer
from dnerf.samplers import OccupancySampler

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))
LOSSES = ("rgb", "elastic", "volume", "folding", "steady", "hidden_matter")


def small_renderer(*, graphs: bool = False, device: str = "cpu", **sampling: object) -> Renderer:
    """Deformation, grid and occupancy in a size that trains in no time."""
    torch.manual_seed(0)
    field = DeformedField(
        DisplacementDeformation(2, 32, (), position_frequencies=2, time_frequencies=2),
        GridField(
            BOX,
            (8, 16),
            4,
            hidden_features=32,
            time_terms=2,
            window_end=0.4,
            space_time=SpaceTimeVolumes(BOX, (8,), (4,)),
        ),
    )
    options = {"num_probes": 512, "min_weight": 1e-4, "split_weight": 0.02, "splits": 2, "pad_to": 1, **sampling}
    sampler = OccupancySampler(BOX, 0.1, 16, **options)  # type: ignore[arg-type]
    return Renderer(field, sampler, RandomBackground(), stop_transmittance=1e-3, graphs=graphs).to(device)


def losses() -> dict[str, Loss]:
    """Those of the fast path and of its flow."""
    steady, hidden = SteadyMatterLoss(), HiddenMatterLoss(BOX, memory_samples=200)
    terms = (PhotometricLoss(), ElasticLoss(), FadingLoss(VolumeLoss()), FoldingLoss(), steady, hidden)
    return dict(zip(LOSSES, terms, strict=True))
