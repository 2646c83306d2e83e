"""Animated scenes whose images are known exactly: convex bodies of constant density that move."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_batch, check_positive, check_shape
from dnerf.core.compositing import FieldOutput, safe_divide
from dnerf.core.rays import Rays, Samples
from dnerf.fields.base import RadianceField, SignedDistance
from dnerf.scenes.motions import Fixed, Motion, world_poses
from dnerf.scenes.poses import Pose
from dnerf.scenes.quadrature import MAX_DEPTH, absorption_rule
from dnerf.scenes.shapes import Shape
from dnerf.scenes.textures import Texture

FAR = 1e3
"""Distance from a body that is not there, in world units."""

NUM_NODES = {torch.float32: 6, torch.float64: 16}
"""Gauss nodes per interval of smooth colour: enough for the rounding of each precision in the scenes here."""


@dataclass(frozen=True)
class Body:
    """A shape of constant density with a colour and a motion.

    Args:
        shape: in the body's frame, as the texture.
        texture: its colours.
        motion: of the body's frame.
        density: at scale 1, in 1 / world unit.
        conserves_mass: whether a body that grows by s gets thinner by s^3; otherwise its density stays.

    Raises:
        ValueError: if the density is not positive.
    """

    shape: Shape
    texture: Texture
    motion: Motion = field(default_factory=Fixed)
    density: float = 80.0
    conserves_mass: bool = False

    def __post_init__(self) -> None:
        check_positive("density", self.density)

    def density_at(self, pose: Pose) -> Tensor:
        """Density inside, (...,) like the pose, in 1 / world unit; 0 while the body is not there."""
        density = self.density / pose.scale**3 if self.conserves_mass else torch.full_like(pose.scale, self.density)
        return density * pose.presence

    def contains(self, pose: Pose, positions: Tensor) -> Tensor:
        """Whether world positions (..., 3) lie inside, (...,) bool; never while the body is not there."""
        return self.shape.contains(pose.to_local(positions)) & (pose.presence > 0)

    def spans(self, pose: Pose, rays: Rays) -> tuple[Tensor, Tensor]:
        """Distances (R, K) at which rays enter and leave, within near and far; both are near where they miss it."""
        near, far = rays.near[:, None], torch.maximum(rays.near, rays.far)[:, None]
        enter, leave = pose.spans(self.shape, rays)
        enter, leave = torch.maximum(enter, near), torch.minimum(leave, far)
        hits = leave > enter
        return torch.where(hits, enter, near), torch.where(hits, leave, near)


class AnalyticScene(RadianceField, SignedDistance):
    """A radiance field without parameters, made of moving bodies, with exact images and exact motion.

    Bodies that overlap add up: densities are summed, colours are averaged by density, as light emitted by both.
    Its methods raise `ValueError` for times or directions whose shapes do not fit the positions.

    Args:
        bodies: at least one. Where they overlap, `body_indices` and `advect` go by the first.
        box: (2, 3) lowest and highest corner of a box that holds all bodies at all times in [0, 1].

    Raises:
        ValueError: without bodies, or for a box that is none.
    """

    def __init__(self, bodies: Sequence[Body], box: Sequence[Sequence[float]] | Tensor) -> None:
        super().__init__()
        if not bodies:
            raise ValueError("bodies must hold at least one body, got none")
        self.bodies = tuple(bodies)
        self.box = nn.Buffer(as_box(box), persistent=False)

    def posed(self, times: Tensor) -> list[tuple[Body, Pose]]:
        """Each body with its poses at times (...,), or with one pose if all times are the same.

        Poses are worked out once for each distinct time: images of one time need one.
        """
        distinct, index = torch.unique(times, return_inverse=True)
        # Chains of joints need full precision whatever the networks run in.
        with torch.autocast(times.device.type, enabled=False):
            poses = world_poses([body.motion for body in self.bodies], distinct)
        return [(body, pose.take(index)) for body, pose in zip(self.bodies, poses)]

    def contains(self, positions: Tensor, times: Tensor) -> Tensor:
        """Which bodies hold which points: (..., B) bool at positions (..., 3) and times (...,)."""
        check_batch("times", times, positions)
        inside = torch.stack([body.contains(pose, positions) for body, pose in self.posed(times)], dim=-1)
        return inside.reshape(*times.shape, len(self.bodies))

    def body_indices(self, positions: Tensor, times: Tensor) -> Tensor:
        """Index (...,) int64 of the first body that holds each point, -1 in empty space."""
        inside = self.contains(positions, times)
        return torch.where(inside.any(-1), inside.to(torch.int8).argmax(dim=-1), -1)

    def distance(self, positions: Tensor, times: Tensor) -> Tensor:
        """Signed distance (...,) of the nearest body; inside where bodies overlap, and beside bent ones, about that."""
        check_batch("times", times, positions)
        nearest = torch.full_like(positions[..., 0], FAR)
        for body, pose in self.posed(times):
            distance = pose.scale * body.shape.distance(pose.to_local(positions))
            nearest = torch.minimum(nearest, torch.where(pose.presence > 0, distance, FAR))
        return nearest.reshape(times.shape)

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) in 1 / world unit at positions (..., 3) and times (...,)."""
        check_batch("times", times, positions)
        density = torch.zeros_like(positions[..., 0])
        for body, pose in self.posed(times):
            density = density + torch.where(body.contains(pose, positions), body.density_at(pose), 0.0)
        return density.reshape(times.shape)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density and colour; colour is black in empty space. Arguments as in `RadianceField`."""
        check_batch("times", times, positions)
        check_shape("directions", directions, positions.shape)
        shape = times.shape
        positions, directions = positions.reshape(-1, 3), directions.reshape(-1, 3)
        density, emission = torch.zeros_like(positions[:, 0]), torch.zeros_like(positions)
        for body, pose in self.posed(times.reshape(-1)):
            local = pose.to_local(positions)
            # Most points lie in one body or none, and colours are the costly part.
            index = body.shape.contains(local).nonzero()[:, 0]
            pose, local = pose.take(index), local[index]
            normals = body.shape.normals(local)
            color = body.texture.color(local, normals, pose.directions_to_local(directions[index]))
            own = body.density_at(pose).expand(len(index))
            density = density.index_add(0, index, own)
            emission = emission.index_add(0, index, own[:, None] * color)
        rgb = safe_divide(emission, density[:, None])
        return FieldOutput(density.reshape(shape), rgb.reshape(*shape, 3))

    def advect(self, positions: Tensor, t0: float | Tensor, t1: float | Tensor, owners: Tensor | None = None) -> Tensor:
        """Carry material points from one time to another, exactly.

        Args:
            positions: (..., 3) at t0, in world units. Points in no body stay where they are.
            t0: in [0, 1], a number or (...,).
            t1: likewise.
            owners: (...,) index of the body that each point belongs to, -1 for none; the first that holds it if None.
                Rounding decides which body holds a point on a surface, so tracks of surfaces state the owners.

        Returns:
            (..., 3), where the same material is at t1.
        """
        before, after = ((t + torch.zeros_like(positions[..., 0])).to(positions) for t in (t0, t1))
        owners = self.body_indices(positions, before) if owners is None else owners
        moved = positions
        for index, ((_, old), (_, new)) in enumerate(zip(self.posed(before), self.posed(after))):
            own = (owners == index)[..., None]
            moved = torch.where(own, new.to_world(old.to_local(positions)), moved)
        return moved.reshape(positions.shape)

    @torch.no_grad()
    def exact_samples(self, rays: Rays) -> Samples:
        """Samples whose compositing is the volume rendering integral to rounding.

        Edges lie where rays cross surfaces and jumps of colour; between two of them density is constant and colour
        smooth, and a Gauss rule of the absorption (see `quadrature`) splits the interval further. What lies
        behind an optical depth that lets through less than rounding gets no samples. Not differentiable.

        Args:
            rays: R rays, each with its own time; empty ones and those that miss get no samples.

        Returns:
            Packed samples with `points` at the Gauss nodes.
        """
        posed = self.posed(rays.times)
        spans = [body.spans(pose, rays) for body, pose in posed]
        hit_indices = torch.cat([leave > enter for enter, leave in spans], dim=-1).any(-1).nonzero()[:, 0]
        hits = rays[hit_indices]
        edges, chords = [], []
        for (body, pose), (enter, leave) in zip(posed, spans):
            pose, enter, leave = pose.take(hit_indices), enter[hit_indices], leave[hit_indices]
            breaks = body.texture.breaks(*pose.local_lines(hits))
            first, last = enter.amin(-1, keepdim=True), leave.amax(-1, keepdim=True)
            pieces = [torch.lerp(enter, leave, k / pose.num_pieces) for k in range(1, pose.num_pieces)]
            edges += [enter, leave, torch.minimum(torch.maximum(breaks, first), last), *pieces]
            chords.append((enter, leave, body.density_at(pose)[:, None]))
        edge = torch.cat(edges, dim=-1).sort(dim=-1).values
        starts, ends = edge[:, :-1], edge[:, 1:]
        density = torch.zeros_like(starts)
        for enter, leave, own in chords:
            for k in range(enter.shape[-1]):
                within = (enter[:, k, None] <= starts) & (ends <= leave[:, k, None])
                density = density + torch.where(within, own, 0.0)
        return _gauss_samples(starts, ends, density, hit_indices, len(rays))


def _gauss_samples(starts: Tensor, ends: Tensor, density: Tensor, ray_indices: Tensor, num_rays: int) -> Samples:
    """Split intervals (H, K) of constant density on rays `ray_indices` (H,) by Gauss rules; leave out unseen ones."""
    depth = density * (ends - starts)
    before = torch.cat([torch.zeros_like(depth[:, :1]), depth.cumsum(-1)[:, :-1]], dim=-1)
    unseen = 5 - math.log(torch.finfo(depth.dtype).eps)
    kept = (depth > 0) & (before < unseen)
    starts, ends, density = starts[kept], ends[kept], density[kept]
    lengths = torch.minimum(ends - starts, MAX_DEPTH / density)
    num_nodes = NUM_NODES[starts.dtype]
    nodes, edges = absorption_rule(density * lengths, num_nodes)
    points = torch.addcmul(starts[:, None], lengths[:, None], nodes.to(starts.dtype))
    inner = torch.addcmul(starts[:, None], lengths[:, None], edges[:, 1:-1].to(starts.dtype))
    edge = torch.cat([starts[:, None], inner, (starts + lengths)[:, None]], dim=-1)
    # Rounding may not reorder what is closer than the last bit.
    edge = torch.minimum(edge.cummax(dim=-1).values, ends[:, None])
    points = torch.minimum(torch.maximum(points, edge[:, :-1]), edge[:, 1:])
    ray_indices = ray_indices[kept.nonzero()[:, 0]].repeat_interleave(num_nodes)
    starts, ends, points = (x.reshape(-1) for x in (edge[:, :-1], edge[:, 1:], points))
    return Samples(starts, ends, num_rays, ray_indices, points)
