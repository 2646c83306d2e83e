"""Dynamic-scene neural radiance fields: one deformation, one canonical field, one exact compositing renderer.

The names below are loaded when they are first used: `import dnerf` alone loads no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dnerf.core.cameras import Camera, Intrinsics, look_at
    from dnerf.core.compositing import Rendering, composite
    from dnerf.core.rays import Rays, Samples
    from dnerf.core.schedules import Schedule
    from dnerf.data.bounds import fit_box
    from dnerf.data.frames import Frames
    from dnerf.data.pixel_samplers import PixelSampler
    from dnerf.deformations.base import Deformation
    from dnerf.evaluation.scores import evaluate
    from dnerf.fields.base import RadianceField
    from dnerf.fields.deformed import DeformedField
    from dnerf.fields.grid import GridField
    from dnerf.fields.nerf import NeRFField
    from dnerf.losses.base import Loss
    from dnerf.rendering.renderer import Renderer
    from dnerf.samplers.base import Sampler
    from dnerf.samplers.occupancy import OccupancySampler
    from dnerf.scenes import make_scene
    from dnerf.training.presets import load_dataset, make_renderer, make_trainer
    from dnerf.training.run import Callback
    from dnerf.training.runs import load_run
    from dnerf.training.trainer import Trainer

__version__ = "0.1.0"

_HOMES = {
    "core.cameras": ("Camera", "Intrinsics", "look_at"), "core.compositing": ("Rendering", "composite"),
    "core.rays": ("Rays", "Samples"), "core.schedules": ("Schedule",), "data.bounds": ("fit_box",),
    "data.frames": ("Frames",), "data.pixel_samplers": ("PixelSampler",), "deformations.base": ("Deformation",),
    "evaluation.scores": ("evaluate",), "fields.base": ("RadianceField",), "fields.deformed": ("DeformedField",),
    "fields.grid": ("GridField",), "fields.nerf": ("NeRFField",), "losses.base": ("Loss",),
    "rendering.renderer": ("Renderer",), "samplers.base": ("Sampler",), "samplers.occupancy": ("OccupancySampler",),
    "scenes": ("make_scene",), "training.run": ("Callback",), "training.runs": ("load_run",),
    "training.presets": ("load_dataset", "make_renderer", "make_trainer"), "training.trainer": ("Trainer",),
}  # fmt: skip
_HOME_OF = {name: f"{__name__}.{home}" for home, names in _HOMES.items() for name in names}

__all__ = [
    "Callback", "Camera", "Deformation", "DeformedField", "Frames", "GridField", "Intrinsics", "Loss", "NeRFField",
    "OccupancySampler", "PixelSampler", "RadianceField", "Rays", "Renderer", "Rendering", "Sampler", "Samples",
    "Schedule", "Trainer", "__version__", "composite", "evaluate", "fit_box", "load_dataset", "load_run", "look_at",
    "make_renderer", "make_scene", "make_trainer",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
