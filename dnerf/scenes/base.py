"""Animated scenes whose pictures are known exactly: convex bodies of constant density that move rigidly or scale."""

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from dnerf.checks import as_box, check_batch, check_shape
from dnerf.compositing import FieldOutput, safe_divide
from dnerf.fields.base import RadianceField
from dnerf.rays import Rays, Samples
from dnerf.scenes.bodies import Body
from dnerf.scenes.motions import world_poses
from dnerf.scenes.poses import Pose
from dnerf.scenes.quadrature import MAX_DEPTH, absorption_rule

NUM_NODES = {torch.float32: 6, torch.float64: 16}
"""Gauss nodes per interval of smooth colour: enough for the rounding of each precision in the scenes here."""


class AnalyticScene(RadianceField):
    """A radiance field without parameters, made of moving bodies, with exact pictures and exact motion.

    Bodies that overlap add up: densities are summed, colours are averaged by density, as light emitted by both.

    Args:
        bodies: at least one. Where they overlap, `body_indices` and `advect` go by the first.
        box: (2, 3) lowest and highest corner of a box that holds all matter at all times in [0, 1].

    Raises:
        ValueError: without bodies, or for a box that is none.
    """

    def __init__(self, bodies: Sequence[Body], box: Sequence[Sequence[float]] | Tensor) -> None:
        super().__init__()
        if not bodies:
            raise ValueError("bodies must hold at least one body, got none")
        self.bodies = tuple(bodies)
        self.register_buffer("box", as_box(box), persistent=False)
        self.box: Tensor

    def contains(self, positions: Tensor, times: Tensor) -> Tensor:
        """Which bodies hold which points: (..., B) bool at positions (..., 3) and times (...,).

        Raises:
            ValueError: if times do not fit positions.
        """
        check_batch("times", times, positions)
        shape, positions = positions.shape[:-1], positions.reshape(-1, 3)
        inside = [body.contains(pose, positions) for body, pose in self._posed(times.reshape(-1))]
        return torch.stack(inside, dim=-1).reshape(*shape, len(self.bodies))

    def body_indices(self, positions: Tensor, times: Tensor) -> Tensor:
        """Index (...,) int64 of the first body that holds each point, -1 in empty space."""
        inside = self.contains(positions, times)
        first = inside.to(torch.int8).argmax(dim=-1)
        return torch.where(inside.any(-1), first, -1)

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) in 1 / world unit at positions (..., 3) and times (...,).

        Raises:
            ValueError: if times do not fit positions.
        """
        check_batch("times", times, positions)
        shape, positions = times.shape, positions.reshape(-1, 3)
        density = torch.zeros_like(positions[:, 0])
        for body, pose in self._posed(times.reshape(-1)):
            inside = body.shape.contains(pose.to_local(positions))
            density = density + torch.where(inside, body.density_at(pose), 0.0)
        return density.reshape(shape)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density and colour; colour is black in empty space. Arguments as in `RadianceField`.

        Raises:
            ValueError: if directions or times do not fit positions.
        """
        check_batch("times", times, positions)
        check_shape("directions", directions, positions.shape)
        shape = times.shape
        positions, directions = positions.reshape(-1, 3), directions.reshape(-1, 3)
        density, emission = torch.zeros_like(positions[:, 0]), torch.zeros_like(positions)
        for body, pose in self._posed(times.reshape(-1)):
            local = pose.to_local(positions)
            # Most points lie in one body or none, and colours are the costly part.
            index = body.shape.contains(local).nonzero()[:, 0]
            pose = pose.take(index)
            color = body.color(local[index], pose.directions_to_local(directions[index]))
            own = body.density_at(pose).expand(len(index))
            density = density.index_add(0, index, own)
            emission = emission.index_add(0, index, own[:, None] * color)
        rgb = safe_divide(emission, density[:, None])
        return FieldOutput(density.reshape(shape), rgb.reshape(*shape, 3))

    def advect(self, positions: Tensor, t0: float | Tensor, t1: float | Tensor) -> Tensor:
        """Carry material points from one time to another, exactly.

        Args:
            positions: (..., 3) at t0, in world units. Points in no body stay where they are; in several, they go
                with the first.
            t0: in [0, 1], a number or (...,).
            t1: likewise.

        Returns:
            (..., 3), where the same material is at t1.
        """
        batch = positions.shape[:-1]
        before, after = (
            torch.as_tensor(t, dtype=positions.dtype, device=positions.device).expand(batch).reshape(-1)
            for t in (t0, t1)
        )
        points = positions.reshape(-1, 3)
        owner = self.body_indices(points, before)
        moved = points
        for index, ((_, old), (_, new)) in enumerate(zip(self._posed(before), self._posed(after))):
            own = (owner == index)[:, None]
            moved = torch.where(own, new.to_world(old.to_local(points)), moved)
        return moved.reshape(positions.shape)

    @torch.no_grad()
    def exact_samples(self, rays: Rays) -> Samples:
        """Samples whose compositing is the volume rendering integral to rounding.

        Edges lie where rays cross surfaces and jumps of colour; between two of them density is constant and colour
        smooth, and a Gauss rule of the absorption (see `quadrature`) splits the interval further. Matter behind an
        optical depth at which less than rounding is left to see gets no samples. Not differentiable.

        Args:
            rays: R rays, each with its own time; empty ones and those that miss get no samples.

        Returns:
            Packed samples with `points` at the Gauss nodes.
        """
        posed = list(self._posed(rays.times))
        far = torch.maximum(rays.near, rays.far)
        spans = []
        for body, pose in posed:
            enter, leave = body.spans(pose, rays.origins, rays.directions, rays.near, far)
            enter, leave = torch.maximum(enter, rays.near[:, None]), torch.minimum(leave, far[:, None])
            hits = leave > enter
            spans.append((torch.where(hits, enter, rays.near[:, None]), torch.where(hits, leave, rays.near[:, None])))
        hit_indices = torch.cat([leave > enter for enter, leave in spans], dim=-1).any(-1).nonzero()[:, 0]
        origins, directions = rays.origins[hit_indices], rays.directions[hit_indices]
        edges, matter = [], []
        for (body, pose), (enter, leave) in zip(posed, spans):
            pose = pose.take(hit_indices)
            enter, leave = enter[hit_indices], leave[hit_indices]
            breaks = body.breaks(pose, origins, directions)
            first, last = enter.amin(-1, keepdim=True), leave.amax(-1, keepdim=True)
            pieces = [torch.lerp(enter, leave, k / pose.num_pieces) for k in range(1, pose.num_pieces)]
            edges += [enter, leave, torch.minimum(torch.maximum(breaks, first), last), *pieces]
            matter.append((enter, leave, body.density_at(pose)[:, None]))
        edge = torch.cat(edges, dim=-1).sort(dim=-1).values
        starts, ends = edge[:, :-1], edge[:, 1:]
        density = torch.zeros_like(starts)
        for enter, leave, own in matter:
            for k in range(enter.shape[-1]):
                within = (enter[:, k, None] <= starts) & (ends <= leave[:, k, None])
                density = density + torch.where(within, own, 0.0)
        return _gauss_samples(starts, ends, density, hit_indices, len(rays))

    def _posed(self, times: Tensor) -> Iterator[tuple[Body, Pose]]:
        """Each body with its poses at times (N,): N of them, or one if all times are the same.

        Poses are worked out once for each distinct time: pictures of one moment need one.
        """
        distinct, index = torch.unique(times, return_inverse=True)
        # Chains of joints need full precision whatever the networks run in.
        with torch.autocast(times.device.type, enabled=False):
            poses = world_poses([body.motion for body in self.bodies], distinct)
        for body, pose in zip(self.bodies, poses):
            yield body, pose.take(index)


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
    return Samples(
        starts=edge[:, :-1].reshape(-1),
        ends=edge[:, 1:].reshape(-1),
        num_rays=num_rays,
        ray_indices=ray_indices[kept.nonzero()[:, 0]].repeat_interleave(num_nodes),
        points=points.reshape(-1),
    )
