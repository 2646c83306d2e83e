"""Curves through key values: straight lines, or cubics that never overshoot."""

import torch
from torch import Tensor

from dnerf.core.checks import check_choice, check_shape

INTERPOLATIONS = ("smooth", "linear")


def interpolate(knots: Tensor, values: Tensor, at: Tensor, kind: str = "smooth") -> Tensor:
    """Evaluate a curve through key values: at (M,) gives (M, C); beyond the knots it stays at the first or last value.

    "smooth" is the monotone piecewise cubic Hermite interpolant with the tangents of Fritsch and Butland (SIAM J. Sci.
    Stat. Comput. 5, 1984, eq. 3.1 with the weights of Brodlie), and the three-point end tangents of Moler's `pchip`:
    once continuously differentiable, and between two knots no component leaves the range of their values. "linear"
    joins the key values by straight lines.

    Knots (K,) are strictly increasing, K >= 1 (else ValueError); values are (K, C).
    """
    check_choice("kind", kind, INTERPOLATIONS)
    check_shape("knots", knots, ("K",))
    check_shape("values", values, (len(knots), "C"))
    if not len(knots) or not bool((knots.diff() > 0).all()):
        raise ValueError(f"knots must be strictly increasing and at least one, got {knots.tolist()}")
    if len(knots) == 1:
        return values.expand(len(at), -1)
    at = at.clamp(knots[0], knots[-1])
    left = (torch.searchsorted(knots, at, right=True) - 1).clamp(0, len(knots) - 2)
    steps = knots.diff()[:, None]
    slopes = values.diff(dim=0) / steps
    step, u = steps[left], ((at - knots[left]) / steps[left, 0])[:, None]
    if kind == "linear":
        return torch.lerp(values[left], values[left + 1], u)
    tangents = _tangents(steps, slopes)
    rise = values[left + 1] - values[left]
    a, b = step * tangents[left] - rise, rise - step * tangents[left + 1]
    return torch.lerp(values[left], values[left + 1], u) + u * (1 - u) * ((1 - u) * a + u * b)


def _tangents(steps: Tensor, slopes: Tensor) -> Tensor:
    """Tangents (K, C) at the knots from steps (K - 1, 1) and slopes (K - 1, C) of the pieces."""
    if len(slopes) == 1:
        return slopes.expand(2, -1)
    before, after = slopes[:-1], slopes[1:]
    weight_before, weight_after = 2 * steps[1:] + steps[:-1], steps[1:] + 2 * steps[:-1]
    turns = before * after <= 0
    one = torch.ones_like(before)
    mean = weight_before / torch.where(turns, one, before) + weight_after / torch.where(turns, one, after)
    inner = torch.where(turns, 0.0, (weight_before + weight_after) / torch.where(turns, one, mean))
    first = _end_tangent(steps[0], steps[1], slopes[0], slopes[1])
    last = _end_tangent(steps[-1], steps[-2], slopes[-1], slopes[-2])
    return torch.cat([first[None], inner, last[None]])


def _end_tangent(near: Tensor, far: Tensor, slope: Tensor, next_slope: Tensor) -> Tensor:
    """The parabola's tangent at an end, bent back where it would overshoot."""
    tangent = ((2 * near + far) * slope - near * next_slope) / (near + far)
    tangent = torch.where(tangent * slope <= 0, 0.0, tangent)
    steep = (slope * next_slope <= 0) & (tangent.abs() > 3 * slope.abs())
    return torch.where(steep, 3 * slope, tangent)
