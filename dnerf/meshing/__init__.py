"""Meshes: a surface in canonical space, moved through time; PLY and OBJ for each frame, animated glTF."""

from dnerf.meshing.animation import Animation, animate, mesh_through_time
from dnerf.meshing.surface import Mesh, extract_surface, vertex_normals
from dnerf.meshing.writers import FORMATS, own_units, write_gltf, write_meshes

__all__ = [
    "FORMATS", "Animation", "Mesh", "animate", "extract_surface", "mesh_through_time", "own_units", "vertex_normals",
    "write_gltf", "write_meshes",
]  # fmt: skip
