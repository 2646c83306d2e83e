"""Real spherical harmonics: a basis of functions of a direction."""

import math

import torch
from torch import Tensor

from dnerf.core.checks import check_choice, check_shape

DEGREES = (0, 1, 2, 3, 4)


def spherical_harmonics(directions: Tensor, degree: int) -> Tensor:
    """All real spherical harmonics up to a degree, of mean square one over the sphere: the first one is one.

    Source: Sloan, "Efficient Spherical Harmonic Evaluation" (JCGT 2013), with the signs of the usual graphics
    convention (Condon-Shortley phase included). Deviation: his, orthonormal on the sphere, times sqrt(4 pi).

    Args:
        directions: (..., 3), unit vectors.
        degree: 0 to 4.

    Returns:
        (..., (degree + 1)^2), degree by degree, in each from order -degree to degree; differentiable.

    Raises:
        ValueError: for another degree or a shape that does not fit.
    """
    check_choice("degree", degree, DEGREES)
    check_shape("directions", directions, (*directions.shape[:-1], 3))
    x, y, z = directions.unbind(-1)
    terms = [torch.ones_like(x)]
    if degree >= 1:
        a = math.sqrt(3)
        terms += [-a * y, a * z, -a * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        a = math.sqrt(15)
        terms += [a * x * y, -a * y * z, math.sqrt(5) / 2 * (2 * zz - xx - yy), -a * x * z, a / 2 * (xx - yy)]
    if degree >= 3:
        a, b, c, d = (math.sqrt(factor) for factor in (35 / 8, 105, 21 / 8, 7 / 4))
        terms += [
            -a * y * (3 * xx - yy), b * x * y * z, -c * y * (4 * zz - xx - yy), d * z * (2 * zz - 3 * xx - 3 * yy),
            -c * x * (4 * zz - xx - yy), b / 2 * z * (xx - yy), -a * x * (xx - 3 * yy),
        ]  # fmt: skip
    if degree >= 4:
        a, b, c, d = (math.sqrt(factor) for factor in (315 / 4, 315 / 8, 45 / 4, 45 / 8))
        terms += [
            a * x * y * (xx - yy), -b * y * z * (3 * xx - yy), c * x * y * (6 * zz - xx - yy),
            -d * y * z * (4 * zz - 3 * xx - 3 * yy), (35 * zz * zz - 30 * zz + 3) * (3 / 8),
            -d * x * z * (4 * zz - 3 * xx - 3 * yy), c / 2 * (xx - yy) * (6 * zz - xx - yy),
            -b * x * z * (xx - 3 * yy), a / 4 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]  # fmt: skip
    return torch.stack(terms, dim=-1)
