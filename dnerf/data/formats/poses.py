"""Camera-to-world matrices of others, made rigid: what is harmless is repaired with a note, what is not is refused."""

import numpy as np

from dnerf.data.formats.json_files import Notes

Pose = tuple[tuple[float, ...], ...]

# Rotations as exact as float32's are kept to the last bit, well within what `Frames` allows (1e-3).
EXACT = 5e-4
# Three decimals leave 2e-3, two leave 2e-2; more is not rounding.
ROUNDED = 2e-2
MAX_SCALE = 1e6
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def rigid_pose(matrix: np.ndarray, where: str, place: str, notes: Notes) -> Pose:
    """A rigid 4 x 4 pose of a 3 x 4 or 4 x 4 float64 matrix, its entries untouched where it is rigid.

    Args:
        where: the field, for errors.
        place: the file, for notes.

    Raises:
        ValueError: if the matrix is not a rotation times one scale, with a position, even roughly.
    """
    if len(matrix) == 3:
        notes.add(f"{place}: a matrix of 3 rows was completed by 0 0 0 1")
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-3:
        hint = "; it looks transposed: list rows" if not matrix[:3, 3].any() and matrix[3, 3] == 1 else ""
        raise ValueError(f"{where} must have the last row 0 0 0 1, got {_row(matrix[3])}{hint}")
    rotation = matrix[:3, :3]
    determinant = float(np.linalg.det(rotation))
    if _deviation(rotation) <= EXACT and determinant > 0:
        return as_pose(matrix)
    if determinant < 0:
        raise ValueError(
            f"{where} must be rigid and right-handed, it mirrors (determinant {determinant:.4g}); "
            "negate one axis where the cameras were exported"
        )
    scale = float(np.cbrt(determinant))
    if not 1 / MAX_SCALE <= scale <= MAX_SCALE or _deviation(rotation / scale) > ROUNDED:
        raise ValueError(
            f"{where} must be rigid: three orthonormal columns and a position, camera to world; "
            f"its rows are {', '.join(_row(row) for row in matrix[:3])}; export it without shear"
        )
    result = matrix.copy()
    if abs(scale - 1) > ROUNDED:
        notes.add(f"{place}: a rotation with a scale of {scale:.4g} was divided by it")
    elif _deviation(rotation) > EXACT:
        notes.add(f"{place}: a rotation that was rounded was made orthonormal")
    left, _, right = np.linalg.svd(rotation / scale)
    result[:3, :3] = left @ right
    result[3] = [0.0, 0.0, 0.0, 1.0]
    return as_pose(result)


def as_pose(matrix: np.ndarray) -> Pose:
    """A 4 x 4 matrix as plain numbers."""
    return tuple(tuple(float(x) for x in row) for row in matrix)


def from_opencv(pose: np.ndarray) -> np.ndarray:
    """A pose whose axes are x right, y down, z forward, in OpenGL's; its own inverse."""
    return pose @ OPENCV_TO_OPENGL


def _deviation(rotation: np.ndarray) -> float:
    return float(np.abs(rotation @ rotation.T - np.eye(3)).max())


def _row(row: np.ndarray) -> str:
    return "[" + " ".join(f"{x:.4g}" for x in row) + "]"
