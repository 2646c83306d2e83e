"""Spherical harmonics against quadrature on the sphere and the Laplacian's eigenvalues."""

import math

import pytest
import torch
from reference import sphere_quadrature

from dnerf.core.spherical_harmonics import DEGREES, spherical_harmonics


@pytest.mark.parametrize("degree", DEGREES)
def test_they_are_orthogonal_of_mean_square_one_and_begin_with_one(degree: int) -> None:
    # Products have degree 8 at most: five Gauss points in z and nine angles integrate them exactly.
    points, weights = sphere_quadrature(5, 9)
    values = spherical_harmonics(points, degree)
    assert values.shape[-1] == (degree + 1) ** 2
    assert (values[:, 0] == 1).all()
    gram = values.T @ (weights[:, None] / (4 * math.pi) * values)
    torch.testing.assert_close(gram, torch.eye((degree + 1) ** 2, dtype=torch.float64), rtol=0, atol=1e-13)


def test_a_degree_holds_those_below_it() -> None:
    points, _ = sphere_quadrature(4, 7)
    for degree in DEGREES[1:]:
        values = spherical_harmonics(points, degree)
        assert torch.equal(values[:, : degree**2], spherical_harmonics(points, degree - 1))


def test_they_have_the_eigenvalues_of_their_degree() -> None:
    """On the unit sphere the Laplacian multiplies degree l by -l (l + 1); here by central differences of rotations."""
    points, _ = sphere_quadrature(4, 7)
    step = 1e-3

    def values(points: torch.Tensor) -> torch.Tensor:
        return spherical_harmonics(points, 4)

    laplacian = torch.zeros(len(points), 25, dtype=torch.float64)
    for axis in range(3):
        angle = torch.zeros(3, 3, dtype=torch.float64)
        angle[(axis + 1) % 3, (axis + 2) % 3] = step
        turn = torch.linalg.matrix_exp(angle - angle.T)
        laplacian += values(points @ turn) + values(points @ turn.T) - 2 * values(points)
    eigenvalues = torch.tensor([-float(l * (l + 1)) for l in range(5) for _ in range(2 * l + 1)])  # noqa: E741
    # Second differences: an error of step^2 l^4 / 12 times values of up to 3, beside rounding of 1e-15 / step^2.
    torch.testing.assert_close(laplacian / step**2, eigenvalues * values(points), rtol=0, atol=4e-4)


def test_they_have_the_graphics_signs() -> None:
    x, y, z = spherical_harmonics(torch.eye(3, dtype=torch.float64), 3)
    assert y[1].item() == pytest.approx(-math.sqrt(3))
    assert z[2].item() == pytest.approx(math.sqrt(3))
    assert x[3].item() == pytest.approx(-math.sqrt(3))
    assert z[6].item() == pytest.approx(math.sqrt(5))
    assert z[12].item() == pytest.approx(math.sqrt(7))
    assert x[15].item() < 0 < x[8].item()


def test_other_degrees_and_shapes_are_named() -> None:
    with pytest.raises(ValueError, match="degree must be one of 0, 1, 2, 3, 4; got 5"):
        spherical_harmonics(torch.eye(3), 5)
    with pytest.raises(ValueError, match=r"directions must have shape \(5, 3\), got \(5, 2\)"):
        spherical_harmonics(torch.zeros(5, 2), 1)
