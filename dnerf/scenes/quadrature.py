"""Gauss rules for light absorbed along a ray through bodies of constant density.

Over an interval of length L and density s the colour reaching the eye is

    integral_0^L c(t) s exp(-s t) dt.

The n-point Gauss rule of the weight exp(-s t) itself (not of the constant weight) integrates every colour that is
a polynomial in t of degree below 2n exactly, however thin or opaque the interval: with one node it is the centroid
of absorption, for s L -> 0 Gauss-Legendre, for s L -> infinity Gauss-Laguerre. By the separation theorem of
Chebyshev, Markov and Stieltjes (Szego 1939, theorem 3.41.1) the nodes interlace with the cumulative weights, so the
rule *is* an alpha-compositing of n sub-intervals, each holding the node where the field is evaluated.
"""

import math
from functools import lru_cache

import torch
from torch import Tensor

MAX_DEPTH = 48.0
"""Optical depth beyond which nothing is left to absorb: exp(-48) = 1e-21."""

_NUM_TERMS = 96
_SCALE = 16.0
_TOP = MAX_DEPTH / (MAX_DEPTH + _SCALE)


def absorption_rule(optical_depth: Tensor, num_nodes: int) -> tuple[Tensor, Tensor]:
    """Gauss nodes and sub-interval edges of intervals with given optical depths, as fractions of their lengths.

    Interpolated in the optical depth from a table of rules; the error, in optical depth, is below 1e-12 (float64).
    Not differentiable by intent: it says where samples lie.

    Args:
        optical_depth: (N,) density times length, in [0, MAX_DEPTH]; cut a deeper interval first.
        num_nodes: n >= 1.

    Returns:
        nodes (N, n) in (0, 1) increasing, and edges (N, n + 1) from 0 to 1 that interlace with them, float64.
    """
    coefficients = _interpolation_table(num_nodes).to(optical_depth.device)
    depth = optical_depth.detach().double().clamp(0, MAX_DEPTH)
    angle = torch.acos((2 / _TOP * depth / (depth + _SCALE) - 1).clamp(-1, 1))
    orders = torch.arange(_NUM_TERMS, device=depth.device, dtype=depth.dtype)
    values = torch.cos(angle[:, None] * orders) @ coefficients
    zero = torch.zeros_like(values[:, :1])
    return values[:, :num_nodes], torch.cat([zero, values[:, num_nodes:], torch.ones_like(zero)], dim=-1)


@lru_cache(maxsize=16)
def _interpolation_table(num_nodes: int) -> Tensor:
    """Chebyshev coefficients (terms, 2n - 1) of nodes and inner edges in z = depth / (depth + scale)."""
    angle = (torch.arange(_NUM_TERMS, dtype=torch.float64) + 0.5) * (math.pi / _NUM_TERMS)
    z = 0.5 * _TOP * (1 + torch.cos(angle))
    nodes, edges = _solve_rule(_SCALE * z / (1 - z), num_nodes)
    basis = torch.cos(torch.arange(_NUM_TERMS, dtype=torch.float64)[:, None] * angle)
    coefficients = (2 / _NUM_TERMS) * basis @ torch.cat([nodes, edges], dim=-1)
    coefficients[0] *= 0.5
    return coefficients


def _solve_rule(depth: Tensor, num_nodes: int) -> tuple[Tensor, Tensor]:
    """Nodes (M, n) and inner edges (M, n - 1) of the Gauss rules of exp(-depth x) on [0, 1], for depths (M,) > 0.

    By the discretised Lanczos process (Gautschi 2004, section 2.2.3.2).
    """
    points, masses = _fejer_rule(192)
    mass = masses * torch.exp(-depth[:, None] * points)
    vector = (mass / mass.sum(-1, keepdim=True)).sqrt()
    basis, diagonal, off_diagonal = [vector], [], []
    for _ in range(num_nodes):
        vector = points * basis[-1]
        diagonal.append((vector * basis[-1]).sum(-1))
        for earlier in basis + basis:  # twice is enough (Kahan): orthogonal to rounding
            vector = vector - (vector * earlier).sum(-1, keepdim=True) * earlier
        off_diagonal.append(vector.norm(dim=-1))
        basis.append(vector / off_diagonal[-1][:, None])
    jacobi = torch.diag_embed(torch.stack(diagonal, -1))
    if num_nodes > 1:
        beside = torch.stack(off_diagonal[:-1], -1)
        jacobi = jacobi + torch.diag_embed(beside, 1) + torch.diag_embed(beside, -1)
    nodes, vectors = torch.linalg.eigh(jacobi)
    # Summed from the far end, where the light left over is many orders smaller than 1.
    beyond = (vectors[:, 0] ** 2).flip(-1).cumsum(-1).flip(-1)[:, 1:]
    left = beyond * -torch.expm1(-depth)[:, None] + torch.exp(-depth)[:, None]
    return nodes, -torch.log(left) / depth[:, None]


def _fejer_rule(num_nodes: int) -> tuple[Tensor, Tensor]:
    """Fejer's first rule on [0, 1]: nodes and positive weights, (n,) float64 each, in closed form (Fejer 1933)."""
    angle = (torch.arange(num_nodes, dtype=torch.float64) + 0.5) * (math.pi / num_nodes)
    orders = torch.arange(1, num_nodes // 2 + 1, dtype=torch.float64)
    series = (torch.cos(2 * angle[:, None] * orders) / (4 * orders * orders - 1)).sum(-1)
    return 0.5 + 0.5 * torch.cos(angle), (1 - 2 * series) / num_nodes
