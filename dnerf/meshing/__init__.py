"""Meshes: a surface in canonical space, moved through time; PLY and OBJ for each frame, animated glTF."""

from dnerf.meshing.animation import Animation, animate, mesh_through_time
from dnerf.meshing.surface import Mesh, extract_surface, share_on_box, vertex_normals
from dnerf.meshing.writers import FORMATS, own_units, write_gltf, write_meshes

__all__ = [
    "FORMATS", "Animation", "Mesh", "animate", "extract_surface", "mesh_through_time", "own_units", "share_on_box",
    "vertex_normals", "write_gltf", "write_meshes",
]  # fmt: skip
