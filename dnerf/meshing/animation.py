"""A canonical surface carried through time by the inverse of a deformation: one topology, one mesh per frame."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from dnerf.core.checks import check_shape
from dnerf.deformations import Deformation, InvertibleDeformation, invert
from dnerf.deformations.base import deformation_at_time
from dnerf.fields import DeformedField, RadianceField
from dnerf.meshing.surface import Mesh, device_of, vertex_normals
from dnerf.motion import motion_model

FOUND = 1e-3  # distance in canonical space, in world units, up to which an inverse counts as found
FEW_ITERATIONS = 6  # from where a vertex was a frame before; those that do not arrive get more
SUPPORTED = 0.5  # share of the frames in which a vertex must be found for its faces to stay
FILLS = 64  # rounds in which vertices that are not found take the mean displacement of their neighbours


@dataclass(frozen=True)
class Animation:
    """A mesh whose vertices move; its triangles and colours stay."""

    mesh: Mesh  # canonical: where the vertices come from
    times: Tensor  # (T,) in [0, 1]
    positions: Tensor  # (T, V, 3) of the vertices, in world units
    is_found: Tensor  # (T, V) bool; positions of others are filled in from their neighbours
    num_left_out: int = 0  # canonical vertices that are not in the mesh, since most frames have no place for them

    def frame(self, index: int) -> Mesh:
        """The mesh of one frame; where nothing has moved, the canonical one."""
        moved = self.positions[index]
        if torch.equal(moved, self.mesh.vertices):
            return self.mesh
        return Mesh(moved, self.mesh.faces, vertex_normals(moved, self.mesh.faces), self.mesh.rgb)

    def summary(self) -> str:
        """How many vertices there are, and of how many the place is not known, in one line."""
        return (
            f"{len(self.mesh.vertices)} vertices, {len(self.mesh.faces)} triangles, {len(self.times)} frames; "
            f"{self.num_left_out} vertices left out, for which most frames have no place; of the others' places "
            f"{1 - self.is_found.float().mean().item():.2%} are filled in from their neighbours"
        )


def mesh_through_time(
    field: RadianceField, times: Tensor, extract: Callable[[RadianceField, float], Mesh], *, start: float
) -> Animation | None:
    """A field's surface, moved to each of some times; None if its motion is not known, so that each has its own.

    Behind a deformation the canonical surface of the time `start` moves; a static field has one frame.

    Args:
        field: in evaluation mode.
        times: (T,) in [0, 1], T > 0, rising.
        extract: gives the surface of a field at a time, see `extract_surface`.
        start: time in [0, 1] of the canonical surface, should that change, and where inverses begin.
    """
    motion = motion_model(field)
    if not isinstance(motion, Deformation):
        return None
    if motion.is_identity:
        return animate(extract(field, start), motion, times.new_tensor([start]))
    deformed = cast(DeformedField, field)
    return animate(extract(deformed.canonical, start), deformed.deformation, times, start=start)


@torch.no_grad()
def animate(mesh: Mesh, deformation: Deformation, times: Tensor, *, start: float = 0.5) -> Animation:
    """Carry a canonical mesh to each time: world = deformation^-1(canonical, time).

    A deformation with a stand-in for one frame (`PerFrame`) is inverted as images see it. A vertex for which no place
    is found moves as its neighbours do. Canonical space may hold what no frame shows: vertices that are found in less
    than half of the frames are left out.

    Args:
        mesh: in canonical space.
        deformation: world -> canonical, in evaluation mode.
        times: (T,) in [0, 1], T > 0, rising.
        start: frames are visited outwards from this time, for inverses to begin where vertices were a frame before.

    Raises:
        ValueError: for times that are none, or if no triangle is found in half of the frames.
    """
    check_shape("times", times, ("T",))
    if not len(times):
        raise ValueError("times must be one at least, got none")
    canonical = mesh.vertices.to(device_of(deformation))
    positions = mesh.vertices.new_empty(len(times), *canonical.shape)
    is_found = torch.empty(positions.shape[:2], dtype=torch.bool)
    first = int((times - start).abs().argmin())
    for order in (range(first, len(times)), range(first - 1, -1, -1)):
        guess = positions[first].to(canonical) if order.step < 0 else canonical
        for i in order:
            guess, residual = _moved(deformation, canonical, float(times[i]), guess)
            positions[i], is_found[i] = guess, residual <= FOUND
    kept = is_found.float().mean(0) >= SUPPORTED
    if not bool(kept[mesh.faces].all(-1).any()):
        raise ValueError("the mesh is empty: no canonical triangle has a place in half of the frames")
    used, faces = mesh.faces[kept[mesh.faces].all(-1)].unique(return_inverse=True)
    mesh = Mesh(mesh.vertices[used], faces, mesh.normals[used], mesh.rgb[used])
    positions, is_found = positions[:, used], is_found[:, used]
    for i in (~is_found.all(-1)).nonzero()[:, 0].tolist():
        positions[i] = mesh.vertices + _filled(positions[i] - mesh.vertices, is_found[i], faces)
    return Animation(mesh, times, positions, is_found, len(canonical) - len(used))


def _moved(deformation: Deformation, canonical: Tensor, time: float, guess: Tensor) -> tuple[Tensor, Tensor]:
    """World positions (V, 3) of canonical ones at a time, and how far their images miss them (V,)."""
    now, times = deformation_at_time(deformation, time), canonical.new_full(canonical.shape[:1], time)
    with torch.autocast(canonical.device.type, enabled=False):
        if isinstance(now, InvertibleDeformation):
            world = now.inverse(canonical, times)
            return world, (now(world, times) - canonical).norm(dim=-1)
        world, residual = invert(now, canonical, times, guess=guess, num_iterations=FEW_ITERATIONS)
        left = ~(residual <= FOUND)
        if bool(left.any()):
            world[left], residual[left] = invert(now, canonical[left], times[left], guess=world[left])
    return world, residual


def _filled(displacements: Tensor, is_known: Tensor, faces: Tensor) -> Tensor:
    """Displacements (V, 3), those that are not known the mean of their neighbours', which are filled first."""
    sums = torch.cat([displacements, torch.ones_like(displacements[:, :1])], dim=-1) * is_known[:, None]
    for _ in range(FILLS):
        touched = faces[(sums[:, 3] == 0)[faces].any(-1)]
        around = torch.zeros_like(sums).index_add_(0, touched.reshape(-1), sums[touched].sum(1).repeat_interleave(3, 0))
        sums = torch.where(sums[:, 3:] == 0, around / around[:, 3:].clamp(min=1), sums)
    return sums[:, :3]
