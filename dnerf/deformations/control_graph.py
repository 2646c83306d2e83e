"""Rigid motions of some hundred nodes, which carry what is near them."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive, check_shape, check_whole
from dnerf.deformations.base import Deformation, check_positions_times
from dnerf.kernels import blend_rigid
from dnerf.nn.encodings import SinusoidalEncoding, TimeEncoding
from dnerf.nn.mlp import MLP
from dnerf.nn.parameter_groups import DeclaresGroups, ParameterGroup, network_groups

MOST_TIMES = 1024  # that are told apart in one call, which is more than there are frames ...
ROUND_TO = 2048  # ... else all are rounded to one of so many, which is far within a frame: probes at random times
LEAST_NODES = 8
ROOT = 1.2207440846057596  # of x^4 = x + 1


class ControlGraphDeformation(Deformation, DeclaresGroups):
    """Nodes that turn and travel, see `blend_rigid`: a point is carried by those nearest to it at its time.

    Motion belongs to nodes, wherever they are: what moves as one body through the box has one motion, which a network
    of place and time has to describe anew at every place. Node k's motion, a turn and a travel, is

        c(n_k) b(t),   c(n): (6, B) by a network of its resting place, b(t): (B,) by a network of time,

    the same B courses of time for all nodes. As c is known everywhere, nodes can be placed anew in mid-training, where
    the body turns out to be (`place`). At first they are spread over the box. More than `MOST_TIMES` different times in
    one call, which probes of occupancy have, are rounded.

    Sources: embedded deformation (Sumner et al. 2007) and sparse control points (SC-GS, arXiv 2312.14937), there from
    canonical to world; deviations: the map is world to canonical with weights of distances at the point's time, as
    DynamicFusion's (Newcombe et al. 2015) are in canonical space, and motions share courses of time, as of Shape of
    Motion (arXiv 2407.13764).

    Args:
        box: (2, 3) corners in which nodes rest at first, in world units.
        num_nodes: K.
        num_courses: B.
        hidden_features: width of both networks.
        num_layers: their hidden layers.
        position_frequencies: octaves of resting places.
        time_frequencies: octaves of times.
        time_embeddings: learnt embeddings of time, half as many as frames at most (`TimeEncoding`); 0 for none.
        embedding_features: how many of each.
        reach: radius of nodes' weights, in mean distances between neighbouring nodes.

    Raises:
        ValueError: for a box or numbers out of range.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], num_nodes: int = 512, num_courses: int = 64, *,
        hidden_features: int = 128, num_layers: int = 3, position_frequencies: int = 3, time_frequencies: int = 5,
        time_embeddings: int = 0, embedding_features: int = 4, reach: float = 1.0,
    ) -> None:  # fmt: skip
        super().__init__()
        corners = as_box(box)
        check_whole("num_nodes", num_nodes)
        check_whole("num_courses", num_courses)
        check_positive("reach", reach)
        if num_nodes < LEAST_NODES:
            raise ValueError(f"num_nodes must be at least {LEAST_NODES}, got {num_nodes}")
        self.reach = reach
        self.encode_places = SinusoidalEncoding(3, position_frequencies)
        self.encode_times = TimeEncoding(time_frequencies, time_embeddings, embedding_features)
        self.num_courses = num_courses
        self.shares = MLP(
            self.encode_places.out_features, hidden_features, num_layers, out_features=6 * num_courses, zero_output=True
        )
        self.courses = MLP(self.encode_times.out_features, hidden_features, num_layers, out_features=num_courses)
        self.nodes = nn.Buffer(_spread(corners, num_nodes))
        self.radius = nn.Buffer(torch.tensor(reach * _spacing(self.nodes)))

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of world positions (..., 3) at times (...,)."""
        check_positions_times(positions, times)
        points, flat = positions.reshape(-1, 3), times.reshape(-1)
        if flat.requires_grad:
            moments, frames = flat, torch.arange(len(flat), device=flat.device)
        else:
            moments, frames = flat.unique(return_inverse=True)
            if len(moments) > MOST_TIMES:
                moments, frames = (flat * ROUND_TO).round().unique(return_inverse=True)
                moments = moments / ROUND_TO
        motions = self.motions(moments.to(points.dtype))
        displacements = blend_rigid(points, frames, motions, self.nodes.to(points.dtype), float(self.radius))
        return (points + displacements).reshape(positions.shape)

    def motions(self, times: Tensor) -> Tensor:
        """Of all nodes at times (F,), as `blend_rigid` takes them, (F, K, 6)."""
        shares = self.shares(self.encode_places(self.nodes.to(times.dtype))).to(times.dtype)
        shares = shares.unflatten(-1, (6, self.num_courses)).flatten(0, 1)
        courses = self.courses(self.encode_times(times[:, None])).to(times.dtype) / self.num_courses
        with torch.autocast(times.device.type, enabled=False):
            return (courses @ shares.mT).unflatten(-1, (-1, 6))

    def parameter_groups(self) -> list[ParameterGroup]:
        """All in "deformation", but for the shares' last layer, in "deformation_output"."""
        return network_groups(self, "deformation", self.shares.output)

    @torch.no_grad()
    def place(self, positions: Tensor) -> None:
        """Let nodes rest at positions (K, 3) from now on, ValueError for another number of them; networks stay."""
        check_shape("positions", positions, tuple(self.nodes.shape))
        self.nodes.copy_(positions)
        self.radius.fill_(self.reach * _spacing(self.nodes))


def _spread(corners: Tensor, count: int) -> Tensor:
    """Points (count, 3) evenly spread over a box: Kronecker's sequence in three dimensions (Roberts 2018)."""
    steps = torch.tensor([ROOT**-k for k in (1, 2, 3)], dtype=torch.float64)
    unit = (0.5 + steps * torch.arange(1, count + 1, dtype=torch.float64)[:, None]) % 1
    return torch.lerp(corners[0], corners[1], unit.to(corners.dtype))


def _spacing(nodes: Tensor) -> float:
    """The mean distance of nodes (K, 3) from their nearest three."""
    distances = torch.cdist(nodes.double(), nodes.double()).topk(4, largest=False).values
    return max(float(distances[:, 1:].mean()), 1e-6)
