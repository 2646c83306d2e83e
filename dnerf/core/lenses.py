"""Lens distortion: how a camera bends the directions that it sees, in the terms of OpenCV and COLMAP.

All functions work on the plane at depth 1, x right and y down. Coefficients are eight numbers, or tensors with one for
each position: k1 to k6, p1, p2.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from dnerf.core.checks import check_choice

MODELS = ("opencv", "fisheye")
MAX_DEGREES = 89  # from the axis: directions are stored as positions in the plane at depth 1
NUM_RADII = 1781  # every twentieth of a degree
ROOM = 1.05  # around the image, for what lies beside it and tangential distortion
SIDE = 9  # positions along each side of an image at which a lens is examined: the most distorted ones
STEPS = 33  # from the axis to each of them
ITERATIONS = (*range(1, 7), 8, 12, 20, 40)  # of Newton's method, the first that suffice; four are usual
TOLERANCE = 1e-11  # of the plane: 1e-7 pixels at a focal length of 10,000
LEAST = 1e-12  # of a radius that is divided by

Coefficients = Sequence[float | Tensor]


@dataclass(frozen=True)
class Distortion:
    """Coefficients of a lens.

    "opencv": `x' = x s + 2 p1 x y + p2 (r^2 + 2 x^2)`, `y' = y s + p1 (r^2 + 2 y^2) + 2 p2 x y` with
    `s = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)`, x right and y down in the plane at depth 1.
    "fisheye" (Kannala and Brandt 2006): `theta' = theta (1 + k1 theta^2 + ... + k4 theta^8)`, theta from the axis.
    Source: OpenCV, calib3d, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model".

    Raises:
        ValueError: for an unknown model, coefficients that are not finite, too many, or tangential of a fisheye lens.
    """

    model: str = "opencv"
    radial: tuple[float, ...] = ()  # k1, k2, ...: at most six of opencv, four of fisheye
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2

    def __post_init__(self) -> None:
        check_choice("model", self.model, MODELS)
        most = 6 if self.model == "opencv" else 4
        if len(self.radial) > most:
            raise ValueError(f"radial must be at most {most} coefficients of a {self.model} lens, got {self.radial}")
        if not all(math.isfinite(value) for value in self.coefficients):
            raise ValueError(f"radial and tangential must be finite, got {self.radial} and {self.tangential}")
        if self.model == "fisheye" and any(self.tangential):
            raise ValueError(f"tangential must be 0 of a fisheye lens, got {self.tangential}")

    @property
    def coefficients(self) -> tuple[float, ...]:
        """The eight numbers k1 to k6, p1, p2."""
        return (*self.radial, *(0.0,) * (6 - len(self.radial)), *self.tangential)


class Region(NamedTuple):
    """What is known of a lens within an image."""

    radius: float  # in the plane at depth 1, undistorted, that holds the image, and within which the lens does not fold
    iterations: int  # of Newton's method, that undistort all of the image


def distort(model: str, coefficients: Coefficients, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Where a lens puts undistorted positions (...) of the plane at depth 1."""
    if model == "fisheye":
        radius = (x * x + y * y).sqrt().clamp(min=LEAST)
        scale = _fisheye(coefficients, radius.atan())[0] / radius
        return x * scale, y * scale
    return _opencv(coefficients, x, y)[:2]


def undistort(
    model: str, coefficients: Coefficients, x: Tensor, y: Tensor, region: tuple[float | Tensor, int]
) -> tuple[Tensor, Tensor]:
    """The inverse of `distort` within a radius, by so many iterations of Newton's method; exact in float64."""
    radius, iterations = region
    distorted = (x * x + y * y).sqrt().clamp(min=LEAST)
    if model == "fisheye":
        largest = torch.as_tensor(radius, dtype=x.dtype, device=x.device).atan()
        theta = distorted.minimum(largest)
        for _ in range(iterations):
            value, slope = _fisheye(coefficients, theta)
            theta = (theta - (value - distorted) / slope).clamp(min=0).minimum(largest)
        scale = theta.tan() / distorted
        return x * scale, y * scale
    u, v = _within(radius, x, y)
    for _ in range(iterations):
        value_x, value_y, xx, xy, yy = _opencv(coefficients, u, v)
        error_x, error_y = value_x - x, value_y - y
        determinant = xx * yy - xy * xy
        u, v = u - (yy * error_x - xy * error_y) / determinant, v - (xx * error_y - xy * error_x) / determinant
        u, v = _within(radius, u, v)
    return u, v


def project_beyond(
    model: str, coefficients: Coefficients, radius: float | Tensor, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor]:
    """`distort` up to a radius, and straight outwards beyond it.

    Polynomials fold over somewhere beyond the image; what lies there must not be projected into it.
    """
    excess = ((x * x + y * y).sqrt() / radius).clamp(min=1)
    u, v = distort(model, coefficients, x / excess, y / excess)
    return u * excess, v * excess


@lru_cache(maxsize=4096)
def examine(distortion: Distortion, left: float, right: float, top: float, bottom: float) -> Region:
    """Examine a lens within a distorted image, given by its edges in the plane at depth 1.

    Raises:
        ValueError: if the lens folds over inside the image, or sees 89 degrees or more from its axis.
    """
    model, coefficients = distortion.model, distortion.coefficients
    share = torch.linspace(0, 1, SIDE, dtype=torch.float64)
    x, y = left + share * (right - left), top + share * (bottom - top)
    x = torch.cat([x, x, torch.full_like(x, left), torch.full_like(x, right)])
    y = torch.cat([torch.full_like(y, top), torch.full_like(y, bottom), y, y])
    radius = _radius(model, coefficients, ROOM * float((x * x + y * y).sqrt().amax()))
    for iterations in ITERATIONS:
        u, v = undistort(model, coefficients, x, y, (radius, iterations))
        again = distort(model, coefficients, u, v)
        error = torch.maximum((again[0] - x).abs(), (again[1] - y).abs()).amax()
        if bool(error <= TOLERANCE) and _is_even(model, coefficients, u, v):
            # One more for what lies between these positions.
            return Region(radius, iterations + 1)
    raise ValueError(
        f"distortion must not fold over inside the image, nor see {MAX_DEGREES} degrees from the axis, got "
        f"{distortion}; its coefficients may be of another model or image size; undistort the images, or crop them"
    )


def _is_even(model: str, coefficients: Coefficients, u: Tensor, v: Tensor) -> bool:
    """Whether nothing folds between the axis and positions; a fisheye's radius tells."""
    if model == "fisheye":
        return True
    steps = torch.linspace(0, 1, STEPS, dtype=torch.float64)[:, None]
    *_, xx, xy, yy = _opencv(coefficients, steps * u, steps * v)
    return bool(((xx * yy - xy * xy > 0) & (xx + yy > 0)).all())


def _radius(model: str, coefficients: Coefficients, distorted: float) -> float:
    """The radius up to which a lens does not fold, at most one that it puts at a distorted one or beyond."""
    radii = torch.linspace(0, math.radians(MAX_DEGREES), NUM_RADII, dtype=torch.float64).tan()
    found = distort(model, (*coefficients[:6], 0.0, 0.0), radii, torch.zeros_like(radii))[0]
    # Tangential terms move a position by at most this much, which may be inwards.
    shifts = 3 * (abs(float(coefficients[6])) + abs(float(coefficients[7]))) * radii * radii
    is_end = (found[1:] <= found[:-1]) | ((found - shifts)[:-1] >= distorted)
    return float(radii[int(is_end.int().argmax())] if bool(is_end.any()) else radii[-1])


def _within(radius: float | Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    scale = (radius / (x * x + y * y).sqrt().clamp(min=LEAST)).clamp(max=1)
    return x * scale, y * scale


def _fisheye(k: Coefficients, theta: Tensor) -> tuple[Tensor, Tensor]:
    """The distorted angle and its derivative."""
    square = theta * theta
    value = 1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3])))
    slope = 1 + square * (3 * k[0] + square * (5 * k[1] + square * (7 * k[2] + square * (9 * k[3]))))
    return theta * value, slope


def _opencv(k: Coefficients, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Distorted x and y, and the derivatives of x by x, of either by the other (they are equal), and of y by y."""
    p1, p2 = k[6], k[7]
    xx, yy, xy = x * x, y * y, x * y
    square = xx + yy
    above = 1 + square * (k[0] + square * (k[1] + square * k[2]))
    below = 1 + square * (k[3] + square * (k[4] + square * k[5]))
    scale = above / below
    above_slope = k[0] + square * (2 * k[1] + square * (3 * k[2]))
    below_slope = k[3] + square * (2 * k[4] + square * (3 * k[5]))
    slope = 2 * (above_slope - scale * below_slope) / below
    return (
        x * scale + 2 * p1 * xy + p2 * (square + 2 * xx), y * scale + p1 * (square + 2 * yy) + 2 * p2 * xy,
        scale + xx * slope + 2 * p1 * y + 6 * p2 * x, xy * slope + 2 * p1 * x + 2 * p2 * y,
        scale + yy * slope + 6 * p1 * y + 2 * p2 * x,
    )  # fmt: skip
