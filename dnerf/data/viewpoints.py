"""What the cameras of a data set say by themselves: which way is up, what they look at, how near and far that is."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.cameras import Intrinsics
from dnerf.core.geometry import distinct_places
from dnerf.data.normalization import Vector
from dnerf.data.pixel_layout import evenly_spread

CLEAR = 0.25  # of the second smallest share of cameras' right axes along a direction: what the smallest may be at most
LEVEL = 0.02  # second smallest share from which right axes span a plane
SAME_UP = math.cos(math.radians(10.0))  # between what a format says and what level cameras show
NOT_DOWN = math.cos(math.radians(70.0))  # likewise where cameras all look one way, perhaps up or down
SAME_AXIS = math.cos(math.radians(0.1))
PARALLEL = 1e-4  # share of view axes across their common direction, below which they meet nowhere
IN_FRONT = 0.8  # share of the cameras that have what they look at in front of them
DEPTHS = (0.5, 1.5)  # planes in terms of the depth that cameras look at
AROUND = 0.5  # of the depth that cameras look at: how far apart cameras stand that go around it
OF_POINTS = (0.8, 1.2)  # planes in terms of the depths of sparse points
ENDS = (0.01, 0.99)  # quantiles of those depths, beyond which they may be wrong
GUESSED = (0.5, 10.0)  # planes in terms of how far apart cameras stand, where they look side by side or outwards
SAME_PLACE = 0.01  # of the distance to what is looked at: closer cameras are one viewpoint
LOOKED_AT = math.cos(math.radians(35.0))  # between a view axis and the direction of what counts as looked at
ONE_SIDE = math.cos(math.radians(60.0))  # half of the angle under which cameras on one side are seen
FEW = 4  # viewpoints
MAX_VIEWS = 200  # looked at, evenly spread
MAX_POINTS = 5000  # likewise


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """Cameras as positions and axes, in any units."""

    positions: Tensor  # (F, 3) float64
    right: Tensor  # (F, 3) float64 unit vectors, as the next two
    up: Tensor
    forward: Tensor  # through the principal point, or where that is outside of the image, its nearest pixel

    @classmethod
    def of(cls, poses: Tensor, intrinsics: Sequence[Intrinsics]) -> "Viewpoints":
        """Those of poses (F, 4, 4), camera to world, and F intrinsics."""
        rotation = poses[:, :3, :3].double()
        shifts = []
        for lens in intrinsics:
            x, y = lens.center
            column, row = min(max(x, 0), lens.width), min(max(y, 0), lens.height)
            shifts.append([(column - x) / lens.focal_x, (y - row) / lens.focal_y, -1.0])
        local = torch.tensor(shifts, dtype=torch.float64)
        forward = torch.nn.functional.normalize((rotation * local[:, None]).sum(-1), dim=-1)
        return cls(poses[:, :3, 3].double(), rotation[..., 0], rotation[..., 1], forward)

    @property
    def spread(self) -> float:
        """The largest distance of a camera from the middle of all."""
        return float((self.positions - self.positions.mean(0)).norm(dim=-1).max())


def measured_up(views: Viewpoints) -> tuple[Tensor | None, bool]:
    """The direction (3,) that cameras hold upwards, None if unclear; and whether right axes say so.

    Up is across the right axes, which people keep level. Where all cameras look one way, right axes span no plane: then
    up is the mean of the cameras' own up axes.
    """
    mean = views.up.mean(0)
    shares, directions = torch.linalg.eigh(views.right.T @ views.right / len(views.right))
    if float(shares[1]) > LEVEL and float(shares[0]) < CLEAR * float(shares[1]):
        across = directions[:, 0]
        if abs(float(across @ mean)) > 0.1:
            return across * torch.sign(across @ mean), True
        return None, False
    return (mean / mean.norm() if float(mean.norm()) > 0.5 else None), False


def choose_up(views: Viewpoints, stated: Vector | None) -> tuple[Vector, str]:
    """Up, and by what: as the format says where cameras do not clearly contradict; else as they hold it; else z."""
    measured, is_level = measured_up(views)
    if stated is not None:
        told = torch.tensor(stated, dtype=torch.float64)
        agreement = SAME_UP if is_level else NOT_DOWN
        if measured is None or float(measured @ told) >= agreement * float(told.norm()):
            return stated, "as the format says"
    if measured is None:
        return (0.0, 0.0, 1.0), "taken to be z, since the cameras do not say"
    axis = int(measured.abs().argmax())
    if float(measured.abs()[axis]) >= SAME_AXIS:
        sign = math.copysign(1.0, float(measured[axis]))
        x, y, z = (sign if i == axis else 0.0 for i in range(3))
    else:
        x, y, z = measured.tolist()
    return (x, y, z), "as the cameras are held"


def common_focus(views: Viewpoints) -> Tensor | None:
    """The point (3,) that is nearest to all view axes; None if they are parallel or most have it behind them.

    Distances count by their first power, so that a few cameras that look elsewhere do not move it.
    """
    across = torch.eye(3, dtype=torch.float64) - views.forward[:, :, None] * views.forward[:, None]
    if float(torch.linalg.eigvalsh(across.mean(0))[0]) < PARALLEL:
        return None
    weights = torch.ones(len(across), dtype=torch.float64)
    floor = 1e-3 * views.spread
    for _ in range(20):
        weighted = weights[:, None, None] * across
        right = (weighted @ views.positions[:, :, None]).sum(0)
        point = torch.linalg.solve(weighted.sum(0), right)[:, 0]
        distances = (across @ (point - views.positions)[:, :, None])[..., 0].norm(dim=-1)
        weights = 1 / distances.clamp(min=floor)
        weights = weights / weights.sum()
    depths = depths_of(views, point)
    return point if float((depths > 0).double().mean()) >= IN_FRONT else None


def depths_of(views: Viewpoints, point: Tensor) -> Tensor:
    """Depths (F,) of a point (3,) along the view axes."""
    return ((point - views.positions) * views.forward).sum(-1)


def planes_of(views: Viewpoints, points: Tensor | None) -> tuple[float, float, str]:
    """z-depths between which the scene lies, in the units of the cameras, and by what they were found."""
    if points is not None and (planes := _planes_of_points(views, points)) is not None:
        return *planes, "from sparse points"
    focus = common_focus(views)
    if focus is not None:
        depths = depths_of(views, focus)
        nearest, farthest = torch.quantile(depths[depths > 0], depths.new_tensor(ENDS)).tolist()
        return DEPTHS[0] * nearest, DEPTHS[1] * farthest, "from what the cameras look at"
    origin = _depth_of_origin(views)
    if views.spread > SAME_PLACE * (origin or 0.0):
        near, far = (factor * views.spread for factor in GUESSED)
        return near, far, "guessed from how far apart the cameras stand: set data.near and data.far"
    # One viewpoint fits a scene of any size.
    depth = origin or 1.0
    return DEPTHS[0] * depth, DEPTHS[1] * depth, "arbitrary: one viewpoint does not tell how far anything is"


def reach_around(views: Viewpoints, focus: Tensor) -> float:
    """The z-depth up to which cameras show what they go around, in their units; infinite for cameras on one side.

    Those that stand close together beside what they look at do not tell its depth well enough.
    """
    depths = depths_of(views, focus)
    if views.spread < AROUND * float(depths.median()):
        return math.inf
    return DEPTHS[1] * float(torch.quantile(depths[depths > 0], ENDS[1]))


def _depth_of_origin(views: Viewpoints) -> float | None:
    """The depth of the data set's own origin, if that is about what the cameras look at."""
    depth = float(depths_of(views, torch.zeros(3, dtype=torch.float64)).median())
    return depth if depth > 0 and depth >= LOOKED_AT * float(views.positions.norm(dim=-1).median()) else None


def _planes_of_points(views: Viewpoints, points: Tensor) -> tuple[float, float] | None:
    points = points[points.isfinite().all(-1)].double()
    points = points[evenly_spread(len(points), MAX_POINTS)]
    chosen = evenly_spread(len(views.positions), MAX_VIEWS)
    depths = ((points[None] - views.positions[chosen, None]) * views.forward[chosen, None]).sum(-1).reshape(-1)
    depths = depths[depths > 0]
    if not len(depths):
        return None
    near, far = torch.quantile(depths, depths.new_tensor(ENDS), interpolation="nearest").tolist()
    return OF_POINTS[0] * near, OF_POINTS[1] * far


def unknown_parts(views: Viewpoints, focus: Tensor | None) -> str | None:
    """What these cameras cannot tell, as a sentence for a warning; None if they see the scene from enough places."""
    count = len(views.positions)
    if count == 1:
        return "there is one training image: nothing says how far anything in it is, or what other sides look like"
    # One camera that stands still has neither focus nor spread.
    distance = max(views.spread, _depth_of_origin(views) or 0.0)
    if focus is not None:
        distance = float(depths_of(views, focus).abs().median())
    places = distinct_places(views.positions, SAME_PLACE * distance, FEW)
    if len(places) == 1:
        return (
            "all training images are of one camera that stands still: depth and what it does not see cannot be "
            "determined; other views than its own will be wrong"
        )
    if len(places) == 2:
        return "the training images are of two viewpoints: only what both see has a depth, other views will be wrong"
    if focus is None or len(places) > FEW:
        return None
    directions = torch.nn.functional.normalize(places - focus, dim=-1)
    middle = torch.nn.functional.normalize(directions.mean(0), dim=0)
    if float((directions @ middle).min()) >= ONE_SIDE:
        return (
            f"the training images are of {len(places)} viewpoints on one side: what faces away from them cannot be "
            "determined"
        )
    return None
