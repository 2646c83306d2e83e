"""Whether cameras look at what they surround: poses in another convention look the other way."""

import numpy as np
from torch import Tensor

from dnerf.data.capture import Capture

MIN_SPREAD = 0.01  # mean squared sine of the angle between view axes: about 6 degrees, less tells nothing
MOST = 0.9  # share of cameras that must agree
MAX_MISS = 0.5  # how far view axes may pass by their common focus, as a share of its distance
MAX_POINTS = 2000


def check_axes(capture: Capture) -> None:
    """Raise if cameras look away from what they surround, as poses with OpenCV's axes do when read as OpenGL's.

    The judge is sparse points where there are any, else the point nearest to all view axes. Cameras that stand still,
    look along one direction, or have no common focus are not judged.

    Raises:
        ValueError: naming the setting that says what the axes are.
    """
    poses = np.array([frame.pose for frames in capture.splits.values() for frame in frames])
    if not looks_away(poses, capture.points):
        return
    raise ValueError(
        f"{capture.path}: the cameras look away from what they surround; set data.axes=opencv if the matrices have the "
        "axes x right, y down, z forward, or data.axes=opengl if they really look outwards"
    )


def looks_away(poses: np.ndarray, points: Tensor | None = None) -> bool:
    """Whether most cameras (N, 4, 4) have their common focus, or most points (P, 3), behind them."""
    centers, forward = poses[:, :3, 3], -poses[:, :3, 2]
    if points is not None and len(points):
        chosen = points[:: -(-len(points) // MAX_POINTS)].double().numpy()
        depths = forward @ chosen.T - (forward * centers).sum(1, keepdims=True)
        return bool((depths < 0).mean() > MOST)
    focus = common_focus(centers, forward)
    if focus is None:
        return False
    depths = ((focus - centers) * forward).sum(1)
    misses = np.linalg.norm(focus - centers - depths[:, None] * forward, axis=1)
    return bool((depths < 0).mean() > MOST and np.median(misses) < MAX_MISS * np.median(np.abs(depths)))


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
