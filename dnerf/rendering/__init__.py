"""From a field to images: what is trained, and how whole images are made."""

from dnerf.rendering.exposure import Exposure
from dnerf.rendering.renderer import Renderer

__all__ = ["Exposure", "Renderer"]
