"""Gauss rules of absorption against moments, Gauss-Legendre and Gauss-Laguerre, and their reading as sub-intervals."""

import numpy as np
import pytest
import torch

from dnerf.scenes.quadrature import MAX_DEPTH, absorption_rule

DEPTHS = [0.0, 1e-300, 1e-12, 1e-3, 0.1, 1.0, 2.5, 7.0, 20.0, 40.0, MAX_DEPTH]


def rule_weights(depth: torch.Tensor, edges: torch.Tensor) -> torch.Tensor:
    """What compositing makes of the sub-intervals."""
    light = torch.exp(-depth[:, None] * edges)
    return light[:, :-1] * -torch.expm1(-depth[:, None] * edges.diff(dim=-1))


@pytest.mark.parametrize("num_nodes", [1, 2, 5, 6, 16])
def test_sub_intervals_partition_and_hold_their_nodes(num_nodes: int) -> None:
    depth = torch.cat([torch.tensor(DEPTHS, dtype=torch.float64), MAX_DEPTH * torch.rand(500, dtype=torch.float64)])
    nodes, edges = absorption_rule(depth, num_nodes)
    assert nodes.shape == (len(depth), num_nodes)
    assert ((edges[:, 0] == 0) & (edges[:, -1] == 1)).all()
    assert ((edges[:, :-1] < nodes) & (nodes < edges[:, 1:])).all()
    nodes, edges = absorption_rule(depth[:0], num_nodes)
    assert (nodes.shape, edges.shape) == ((0, num_nodes), (0, num_nodes + 1))


@pytest.mark.parametrize("num_nodes", [1, 2, 4, 6, 10, 16])
@pytest.mark.parametrize("depth", DEPTHS[2:])
def test_polynomials_below_degree_2n_are_integrated_exactly(num_nodes: int, depth: float) -> None:
    tensor = torch.tensor([depth], dtype=torch.float64)
    nodes, edges = absorption_rule(tensor, num_nodes)
    weights = rule_weights(tensor, edges)[0]
    x, w = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(100))
    x, w = 0.5 * (x + 1), 0.5 * w
    for degree in range(2 * num_nodes):
        # Legendre polynomials: powers would hide errors behind their near dependence.
        basis = np.polynomial.legendre.Legendre.basis(degree, domain=[0, 1])
        truth = (w * depth * torch.exp(-depth * x) * torch.from_numpy(basis(x.numpy()))).sum().item()
        found = (weights * torch.from_numpy(basis(nodes[0].numpy()))).sum().item()
        # The table is good to 1e-12 in optical depth; a polynomial of degree d changes at most 2 d^2 times as fast.
        assert abs(found - truth) < 2e-14 * max(1, degree**2) * max(1.0, min(depth, 1.0))


def test_thin_intervals_get_gauss_legendre() -> None:
    nodes, edges = absorption_rule(torch.zeros(1, dtype=torch.float64), 6)
    x, w = np.polynomial.legendre.leggauss(6)
    # Interpolated from depths above 0, where rounding is divided by the depth.
    torch.testing.assert_close(nodes[0], torch.from_numpy(0.5 * (x + 1)), rtol=0, atol=1e-11)
    torch.testing.assert_close(edges[0, 1:], torch.from_numpy(0.5 * w.cumsum()), rtol=0, atol=1e-11)


def test_opaque_intervals_get_gauss_laguerre() -> None:
    nodes, _ = absorption_rule(torch.tensor([MAX_DEPTH], dtype=torch.float64), 5)
    x, _ = np.polynomial.laguerre.laggauss(5)
    # The light beyond the cut, exp(-48), times the size of the polynomials there.
    torch.testing.assert_close(MAX_DEPTH * nodes[0], torch.from_numpy(x), rtol=0, atol=1e-8)
