"""What images alone say about a scene, before any training."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch

from dnerf.core.geometry import ray_box
from dnerf.data.background_check import SAME_LEVELS, background_color
from dnerf.data.carving import EVERY_PIXEL, Silhouettes
from dnerf.data.frames import Frames
from dnerf.data.pixel_layout import evenly_spread
from dnerf.rendering.exposure import rig_places

MAX_RAYS = 1000  # of outlines
MAX_VIEWS = 60  # evenly spread
NUM_DISTANCES = 64  # along each ray
REACH = 1  # blocks of pixels by which outlines may be off
NOT_CLEAR = 2  # alpha, of 255, from which a pixel shows something, be it fog
AGREEMENT = 0.98  # share of the views in which one position is not empty, so that a body at rest explains a ray
LEAST_CAMERAS = 3  # of a rig, to see a body from several sides
MAX_CAMERAS = 8  # that do not move, as rigs for tomography have: more tell what is thin from what is dark
MIXTURES = 0.995  # share of the pixels: some of a compressed film have other colours
CELLS = {"coarse": 64, "medium": 128, "fine": 256, "finest": 512}  # of a grid's last level
CLEAR_SHARE = 0.01  # of rays without such a position: fewer may be faults of single images


@dataclass(frozen=True)
class Finding:
    """What was found, and why."""

    choice: str  # name of a candidate
    why: str  # in a few words
    is_certain: bool = True  # otherwise it stands until a trial says something else


class Evidence(ABC):
    """Looks at the training frames and may decide a part."""

    @abstractmethod
    def find(self, frames: Frames, box: torch.Tensor) -> Finding | None:
        """What the images say of what is modelled in a box (2, 3); None where they do not decide."""


class MotionEvidence(Evidence):
    """Whether anything moves: candidates "still" and "moves".

    Frames of one time show nothing moving. Otherwise silhouettes can prove motion: at rest, every opaque pixel shows a
    position that no other view sees as empty (the visual hull, Laurentini 1994). That they agree does not prove rest,
    since a body may turn inside its outline, but rest stands until a trial says otherwise.
    """

    def find(self, frames: Frames, box: torch.Tensor) -> Finding | None:
        """See `Evidence.find`."""
        if len(frames.times.unique()) == 1:
            return Finding("still", "all frames have one time")
        if not frames.is_transparent:
            return None
        share = unexplained_share(frames, box)
        if share <= CLEAR_SHARE:
            return Finding("still", "all outlines agree with a body at rest", is_certain=False)
        return Finding("moves", f"{100 * share:.0f} % of the outlines contradict a body at rest")


class DetailEvidence(Evidence):
    """How fine a grid has to be: candidates "coarse", "medium", "fine", "finest", with 64 to 512 cells along the box.

    Cells of the last level are no smaller than a pixel at the box's middle (median of the cameras): nobody sees finer.
    """

    def find(self, frames: Frames, box: torch.Tensor) -> Finding:
        """See `Evidence.find`."""
        side = float((box[1] - box[0]).max())
        distances = (frames.poses[:, :3, 3] - box.mean(0)).norm(dim=-1).clamp(min=side / 2)
        focal = distances.new_tensor([lens.focal_x for lens in frames.intrinsics])
        pixels = float((side * focal / distances).median())
        fit = [name for name, cells in CELLS.items() if cells <= pixels] or list(CELLS)[:1]
        return Finding(fit[-1], f"the box is {pixels:.0f} pixels long")


class SurroundingsEvidence(Evidence):
    """Whether something lies beyond the box: candidates "alone" and "surrounded".

    Images with alpha, or before one plain colour, show a scene that stands alone; others show something everywhere.
    """

    def find(self, frames: Frames, box: torch.Tensor) -> Finding:
        """See `Evidence.find`."""
        if frames.is_transparent:
            return Finding("alone", "the images have alpha")
        if background_color(frames) is not None:
            return Finding("alone", "the images have one plain colour behind")
        return Finding("surrounded", "the images show something everywhere")


class ColorsEvidence(Evidence):
    """Whether what is seen is of one colour, as smoke is: candidates "one" and "many".

    Before a plain background what is thin looks like what is dark. Few cameras that stand still cannot tell the two
    apart: each image is explained by a cloud of its own. If all pixels are mixtures of the background and one colour,
    density alone explains them, as in HyFluid's code (arXiv 2312.06561). That is certain here, since trials compare on
    frames of the same cameras, where clouds of their own do well. A grey body before black is taken for smoke, too.
    """

    def find(self, frames: Frames, box: torch.Tensor) -> Finding:
        """See `Evidence.find`."""
        behind = None if frames.is_transparent else background_color(frames)
        if behind is None:
            return Finding("many", "the images have alpha, or show something everywhere")
        cameras = len(frames.poses.unique(dim=0))
        if not cameras < len(frames) or cameras > MAX_CAMERAS:
            return Finding("many", f"{cameras} viewpoints of {len(frames)} frames are not a few that stand still")
        if mixture_share(frames, behind) < MIXTURES:
            return Finding("many", "the images have colours that no single one makes")
        return Finding("one", f"all pixels are mixtures of the background and one colour, for {cameras} cameras")


class AppearanceEvidence(Evidence):
    """Whether appearance may change while it moves: "carried" for a film, whose camera sees one side at a moment."""

    def find(self, frames: Frames, box: torch.Tensor) -> Finding | None:
        """See `Evidence.find`; None for a scene that stands alone, and for a rig."""
        is_alone = SurroundingsEvidence().find(frames, box).choice == "alone"
        is_open = is_alone or len(rig_places(frames.poses[:, :3, 3])) >= LEAST_CAMERAS
        return None if is_open else Finding("carried", "few cameras see a place at a moment")


class ExposureEvidence(Evidence):
    """Whether exposures differ: "steady" or "drifts". It stands for cameras of a rig until a trial says otherwise."""

    def find(self, frames: Frames, box: torch.Tensor) -> Finding | None:
        """See `Evidence.find`; None for cameras that move, and for one alone."""
        cameras = len(rig_places(frames.poses[:, :3, 3]))
        why = f"{cameras} cameras stand still, each with its own exposure"
        return Finding("drifts", why, is_certain=False) if cameras > 1 else None


def mixture_share(frames: Frames, behind: torch.Tensor) -> float:
    """The share of pixels that are mixtures of a colour (3,) in [0, 1] behind and one other, up to `SAME_LEVELS`."""
    images = (frames.stored_image(i)[::EVERY_PIXEL, ::EVERY_PIXEL, :3] for i in evenly_spread(len(frames), MAX_VIEWS))
    away = torch.cat([image.flatten(0, 1) for image in images]).float() - 255 * behind.to(frames.poses.device)
    color = torch.linalg.eigh(away.T @ away)[1][:, -1]
    color = color * torch.sign((away @ color).sum())
    return float(((away - (away @ color).clamp(min=0)[:, None] * color).norm(dim=-1) <= SAME_LEVELS).float().mean())


def unexplained_share(frames: Frames, box: torch.Tensor) -> float:
    """The share of outlines' rays without a position that nearly all views see as not empty."""
    views = frames if len(frames) <= MAX_VIEWS else frames.subset(evenly_spread(len(frames), MAX_VIEWS))
    rays = Silhouettes.of(views).outlines()[1]
    enter, leave = ray_box(rays.origins, rays.directions, box)
    enter, leave = enter.maximum(rays.near), leave.minimum(rays.far)
    kept = (enter < leave).nonzero()[:, 0]
    kept = kept[:: max(1, -(-len(kept) // MAX_RAYS))]
    if not len(kept):
        return 0.0
    steps = (torch.arange(NUM_DISTANCES, device=kept.device) + 0.5) / NUM_DISTANCES
    distances = enter[kept, None] + (leave - enter)[kept, None] * steps
    seen = Silhouettes.of(views, least=NOT_CLEAR, unknown=255.0).share_of_views(rays[kept], distances, REACH)
    return float((seen.amax(1) < AGREEMENT).float().mean())
