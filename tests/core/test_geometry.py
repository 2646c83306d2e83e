"""Boxes against exact arithmetic, rotations and rigid motions against matrix exponentials."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference import line_in_box, rotation_coefficients
from torch import Tensor

from dnerf.core.geometry import (
    _rotation_coefficients,
    clip_to_box,
    move_by_twists,
    ray_box,
    safe_normalize,
    skew,
    so3_exp,
)

BOX = torch.tensor([[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]], dtype=torch.float64)

# Around the switch between series and closed form (angle 0.5), at the bad points, and over a whole turn.
ANGLES = [
    0.0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-4, 1e-2, 0.1, 0.3,
    0.5 - 1e-9, math.nextafter(0.5, 0), 0.5, math.nextafter(0.5, 1), 0.5 + 1e-9,
    1.0, math.pi / 2, 3.0, math.pi - 1e-9, math.pi, 4.0, 6.0, 2 * math.pi,
]  # fmt: skip


def row(*values: float) -> Tensor:
    return torch.tensor([values], dtype=torch.float64)


def axis_of(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)


@pytest.mark.parametrize(("origin", "direction", "expected"), [
    pytest.param((-5, 0, 0), (1, 0, 0), (4, 6), id="along an axis through the middle"),
    pytest.param((-5, 0, 0), (-1, 0, 0), (-6, -4), id="the box lies behind"),
    pytest.param((0, 0, 0), (0, 0, 2), (-1.5, 1.5), id="starts inside, direction of length 2"),
    pytest.param((0, 2, -5), (0, 0, 1), (2, 8), id="in a face"),
    pytest.param((1, 2, -5), (0, 0, 1), (2, 8), id="in an edge"),
    pytest.param((1, 2, -5), (-0.0, 0.0, 1), (2, 8), id="in an edge, negative zero"),
    pytest.param((-2, 1, 0), (1, 1, 0), (1, 1), id="grazes an edge"),
    pytest.param((0, 1, 4), (1, 1, -1), (1, 1), id="grazes a corner"),
    pytest.param((-1, -2, -3), (1, 2, 3), (0, 2), id="starts in a corner, along the diagonal"),
])  # fmt: skip
def test_line_enters_and_leaves_box(
    origin: tuple[float, ...], direction: tuple[float, ...], expected: tuple[float, float]
) -> None:
    enter, leave = ray_box(row(*origin), row(*direction), BOX)
    assert (enter.item(), leave.item()) == expected


@pytest.mark.parametrize(("origin", "direction"), [
    pytest.param((-5, 2.1, 0), (1, 0, 0), id="parallel to a face, outside"),
    pytest.param((-5, 0, 3.0000001), (1, 0, 0), id="parallel to a face, just outside"),
    pytest.param((-5, 0, 0), (1, 1, 0), id="slanted"),
    pytest.param((5, 5, 5), (0, 0, 1), id="along an axis"),
])  # fmt: skip
def test_line_that_misses_leaves_before_it_enters(origin: tuple[float, ...], direction: tuple[float, ...]) -> None:
    enter, leave = ray_box(row(*origin), row(*direction), BOX)
    assert enter.item() > leave.item()


# Multiples of 1/4 make grazes, faces and zero components likely, and every quotient is exact enough to compare.
quarters = st.integers(-12, 12).map(lambda n: n / 4)
vectors = st.tuples(quarters, quarters, quarters)


@given(origin=vectors, direction=vectors.filter(any))
def test_ray_box_agrees_with_exact_arithmetic(origin: tuple[float, ...], direction: tuple[float, ...]) -> None:
    enter, leave = (x.item() for x in ray_box(row(*origin), row(*direction), BOX))
    expected = line_in_box(origin, direction, BOX[0].tolist(), BOX[1].tolist())
    if expected is None:
        assert enter > leave
    else:
        # One rounded division each; the grazing case enter = leave is the same quotient up to it.
        assert (enter, leave) == pytest.approx(expected, rel=1e-15, abs=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("tiny", [0.0, 5e-324, 1e-42, 1e-20, -1e-19, 1e-18, 1e-16])
def test_ray_box_has_finite_gradients_with_tiny_components(tiny: float, dtype: torch.dtype) -> None:
    """Up to squares that are no number of the dtype, for faces up to a million units away."""
    for height in (0.5, 1e6):
        box = BOX.to(dtype) * (2 * height)
        origins = torch.tensor([[-10 * height, height, 0.0]], dtype=dtype, requires_grad=True)
        directions = torch.tensor([[1.0, tiny, -tiny]], dtype=dtype, requires_grad=True)
        enter, leave = ray_box(origins, directions, box)
        (enter + leave).sum().backward()
        assert origins.grad.tolist() == [[-2, 0, 0]]
        assert torch.isfinite(directions.grad).all()


def test_clipping_keeps_the_part_inside() -> None:
    origins = torch.tensor([[-5.0, 0, 0], [-5.0, 0, 0], [0, 0, 0], [-5.0, 9, 0], [-5.0, 0, 0], [-2.0, 1, 0]])
    directions = torch.tensor([[1.0, 0, 0]] * 5 + [[1.0, 1, 0]])
    near = torch.tensor([0.0, 5, 0, 2, 0, 0])
    far = torch.tensor([10.0, 5.5, 10, 10, 3, 10])
    start, end = clip_to_box(origins, directions, near, far, BOX.float())
    # Through; already inside; from inside; a miss; ends before; a graze: the last three are empty at their near.
    assert start.tolist() == [4, 5, 0, 2, 0, 0]
    assert end.tolist() == [6, 5.5, 1, 2, 0, 0]


def test_clipping_keeps_an_empty_ray_empty() -> None:
    start, end = clip_to_box(row(0, 0, 0), row(1, 0, 0), torch.tensor([0.5]), torch.tensor([0.5]), BOX)
    assert start.item() == end.item() == 0.5
    start, end = clip_to_box(row(0, 0, 0), row(1, 0, 0), torch.tensor([0.5]), torch.tensor([0.2]), BOX)
    assert start.item() == end.item() == 0.5


def test_box_of_another_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"box must have shape \(2, 3\), got \(3, 2\)"):
        ray_box(row(0, 0, 0), row(1, 0, 0), torch.zeros(3, 2))


def test_skew_matrix_times_vector_is_cross_product() -> None:
    a, b = torch.rand(2, 7, 3, dtype=torch.float64)
    torch.testing.assert_close((skew(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b), rtol=1e-14, atol=1e-16)


@pytest.mark.parametrize("angle", ANGLES)
def test_so3_exp_is_the_matrix_exponential(angle: float) -> None:
    for seed in range(4):
        rotation_vector = angle * axis_of(seed)
        expected = torch.linalg.matrix_exp(skew(rotation_vector))
        # torch's matrix_exp itself is off by 7e-14 at an angle of 0.01; ours is held to 1e-14 below.
        torch.testing.assert_close(so3_exp(rotation_vector), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("angle", ANGLES)
def test_points_are_moved_by_the_matrix_exponential_of_twists(angle: float) -> None:
    for seed in range(4):
        twist, point = torch.cat([angle * axis_of(seed), axis_of(seed + 10)]), 2 * axis_of(seed + 20)
        generator = torch.zeros(4, 4, dtype=torch.float64)
        generator[:3, :3], generator[:3, 3] = skew(twist[:3]), twist[3:]
        matrix = torch.linalg.matrix_exp(generator)
        moved = move_by_twists(twist, point)
        torch.testing.assert_close(moved, matrix[:3, :3] @ point + matrix[:3, 3], rtol=0, atol=3e-13)
        # A few float32 roundings of numbers up to three, and of an angle times the arm.
        single = move_by_twists(twist.float(), point.float())
        torch.testing.assert_close(single.double(), moved, rtol=0, atol=2e-6)
        with torch.autocast("cpu", dtype=torch.bfloat16):  # where matrix products would run in bfloat16
            assert torch.equal(move_by_twists(twist.float(), point.float()), single)


@pytest.mark.parametrize("angle", ANGLES)
def test_rotation_coefficients_keep_their_relative_precision(angle: float) -> None:
    """Inside the matrices the loss would hide behind the identity in value, not in derivatives."""
    coefficients = [c.item() for c in _rotation_coefficients(row(angle, 0, 0))]
    # At a whole turn sin and 1 - cos are zero: there the precision is that of the angle.
    absolute = 2e-16 if angle >= 3 else 0.0
    for coefficient, exact in zip(coefficients, rotation_coefficients(angle), strict=True):
        assert coefficient == pytest.approx(exact, rel=1e-13, abs=absolute)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.4999, 0.5001, 1.0, 3.1])
def test_gradcheck_of_exponentials(angle: float) -> None:
    twist = torch.cat([angle * axis_of(3), axis_of(4)]).requires_grad_()
    assert torch.autograd.gradcheck(so3_exp, (twist.detach()[:3].requires_grad_(),))
    point = axis_of(5).requires_grad_()
    assert torch.autograd.gradcheck(move_by_twists, (twist, point))


def test_exponentials_have_second_derivatives_at_zero() -> None:
    twist, point = torch.zeros(6, dtype=torch.float64, requires_grad=True), axis_of(5).requires_grad_()
    assert torch.autograd.gradgradcheck(move_by_twists, (twist, point))


def test_gradient_of_so3_exp_at_zero_is_the_skew_matrix() -> None:
    zero = torch.zeros(3, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(so3_exp, zero)
    torch.testing.assert_close(jacobian.movedim(-1, 0), skew(torch.eye(3, dtype=torch.float64)), rtol=0, atol=0)


def test_empty_batches_pass() -> None:
    assert so3_exp(torch.empty(0, 3)).shape == (0, 3, 3)
    assert move_by_twists(torch.empty(0, 6), torch.empty(0, 3)).shape == (0, 3)


def test_twists_of_another_size_are_named() -> None:
    with pytest.raises(ValueError, match=r"twists must have shape \(..., 6\), got \(4, 3\)"):
        move_by_twists(torch.zeros(4, 3), torch.zeros(4, 3))
    with pytest.raises(ValueError, match=r"rotation_vectors must have shape \(..., 3\), got \(\)"):
        so3_exp(torch.tensor(1.0))


def test_zero_vector_stays_zero_with_zero_gradient() -> None:
    vectors = torch.tensor([[0.0, 0, 0], [3.0, 0, 4.0]], requires_grad=True)
    unit = safe_normalize(vectors)
    unit.sum().backward()
    torch.testing.assert_close(unit, torch.tensor([[0, 0, 0], [0.6, 0, 0.8]]))
    assert vectors.grad[0].tolist() == [0, 0, 0]
    assert torch.isfinite(vectors.grad).all()


@pytest.mark.parametrize("length", [1e-30, 1e-12, 1.0, 1e12, 1e30])
def test_normalized_vectors_have_unit_length_at_any_scale(length: float) -> None:
    vectors = length * torch.tensor([[0.6, -0.8, 0.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(safe_normalize(vectors).norm(dim=-1), torch.ones(2))


def test_gradcheck_of_safe_normalize() -> None:
    assert torch.autograd.gradcheck(safe_normalize, (torch.randn(4, 3, dtype=torch.float64, requires_grad=True),))
