"""Whether cameras look at what they surround: poses in another convention look elsewhere."""

import numpy as np
from torch import Tensor

from dnerf.data.capture import Capture
from dnerf.data.formats.poses import from_opencv

MIN_SPREAD = 0.01  # mean squared sine of the angle between view axes: about 6 degrees, less tells nothing
MOST = 0.9  # share of cameras that must agree
MAX_MISS = 0.5  # how far view axes may pass by their common focus, as a share of its distance
CLEAR_MISS = 0.2  # the same for matrices read as their inverse, which must fit better than by chance
MAX_POINTS = 2000


def check_axes(capture: Capture) -> None:
    """Raise if cameras look away from what they surround, as poses in another convention do.

    OpenCV's axes read as OpenGL's look the other way; matrices from world to camera look at one place as soon as they
    are inverted. The judge is sparse points where there are any, else the point nearest to all view axes. Cameras that
    stand still, look along one direction, or have no common focus are not judged.

    Raises:
        ValueError: naming the setting that says what the axes are.
    """
    poses = np.array([frame.pose for frames in capture.splits.values() for frame in frames])
    if looks_away(poses, capture.points):
        raise ValueError(
            f"{capture.path}: the cameras look away from what they surround; set data.axes=opencv if the matrices have "
            "the axes x right, y down, z forward, or data.axes=opengl if they really look outwards"
        )
    if capture.points is None and looks_inverted(poses):
        raise ValueError(
            f"{capture.path}: the cameras have no common sight, but would if the matrices were from world to camera; "
            "write their inverse, camera to world, or set data.axes=opengl if they are that already"
        )


def looks_away(poses: np.ndarray, points: Tensor | None = None) -> bool:
    """Whether most cameras (N, 4, 4) have their common focus, or most points (P, 3), behind them."""
    if points is not None and len(points):
        centers, forward = poses[:, :3, 3], -poses[:, :3, 2]
        chosen = points[:: -(-len(points) // MAX_POINTS)].double().numpy()
        depths = forward @ chosen.T - (forward * centers).sum(1, keepdims=True)
        return bool((depths < 0).mean() > MOST)
    return _surrounds(from_opencv(poses), MAX_MISS)


def looks_inverted(poses: np.ndarray) -> bool:
    """Whether the inverses of poses (N, 4, 4), of either axes, clearly look at one place, and the poses do not."""
    if _surrounds(poses, MAX_MISS):
        return False
    inverses = np.linalg.inv(poses)
    return any(_surrounds(candidate, CLEAR_MISS) for candidate in (inverses, from_opencv(inverses)))


def _surrounds(poses: np.ndarray, max_miss: float) -> bool:
    """Whether most cameras have the common focus of their view axes in front of them, and pass it closely."""
    centers, forward = poses[:, :3, 3], -poses[:, :3, 2]
    focus = common_focus(centers, forward)
    if focus is None:
        return False
    depths = ((focus - centers) * forward).sum(1)
    misses = np.linalg.norm(focus - centers - depths[:, None] * forward, axis=1)
    return bool((depths > 0).mean() > MOST and np.median(misses) < max_miss * np.median(np.abs(depths)))


def common_focus(centers: np.ndarray, forward: np.ndarray) -> np.ndarray | None:
    """The point (3,) nearest to all lines from `centers` (N, 3) along unit `forward` (N, 3), in least squares.

    None where the lines are too nearly parallel to have one.
    """
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = across.mean(0)
    if np.linalg.eigvalsh(total)[0] < MIN_SPREAD:
        return None
    middle = centers.mean(0)
    return middle + np.linalg.solve(total, (across @ (centers - middle)[:, :, None]).mean(0)[:, 0])
