"""Data sets: images with cameras and times, and where they come from."""

from dnerf.data.capture import SPLITS
from dnerf.data.folder import FolderData
from dnerf.data.formats.writers import save_blender, save_transforms
from dnerf.data.frames import Frames, composite_on
from dnerf.data.phone_film import film_by_phone, film_by_rig
from dnerf.data.scene_record import SceneRecord, World
from dnerf.data.source import DataSource, SyntheticData
from dnerf.data.synthetic import random_views, render_exact, render_frames

__all__ = [
    "SPLITS", "DataSource", "FolderData", "Frames", "SceneRecord", "SyntheticData", "World", "composite_on",
    "film_by_phone", "film_by_rig", "random_views", "render_exact", "render_frames", "save_blender", "save_transforms",
]  # fmt: skip
