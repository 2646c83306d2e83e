"""Checks of arguments say what was expected and what came."""

import math
import re

import pytest
import torch

from dnerf.core.checks import as_box, check_batch, check_choice, check_positive, check_shape, check_whole


@pytest.mark.parametrize(("shape", "expected"), [
    ((4096, 1), "times must have shape (4096,), got (4096, 1)"), ((), "times must have shape (4096,), got ()"),
    ((4095,), "times must have shape (4096,), got (4095,)"),
])  # fmt: skip
def test_wrong_shape_is_named(shape: tuple[int, ...], expected: str) -> None:
    with pytest.raises(ValueError) as error:
        check_shape("times", torch.zeros(shape), (4096,))
    assert str(error.value) == expected


def test_letters_stand_for_any_size() -> None:
    check_shape("x", torch.zeros(0, 3), ("R", 3))
    check_shape("x", torch.zeros(7, 3), ("R", 3))
    with pytest.raises(ValueError, match=r"x must have shape \(R, 3\), got \(3,\)"):
        check_shape("x", torch.zeros(3), ("R", 3))


def test_batch_of_positions_is_expected() -> None:
    check_batch("times", torch.zeros(2, 5), torch.zeros(2, 5, 3))
    check_batch("times", torch.tensor(0.0), torch.zeros(3))
    with pytest.raises(ValueError, match=r"times must have shape \(2, 5\), got \(2, 5, 1\)"):
        check_batch("times", torch.zeros(2, 5, 1), torch.zeros(2, 5, 3))


@pytest.mark.parametrize("value", [0, -1, -1e-30, math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_positive_and_finite_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match=rf"radius must be > 0 and finite, got {value}"):
        check_positive("radius", value)


@pytest.mark.parametrize(("value", "expected"), [(0.5, "a whole number"), (1e-9, "a whole number"), (-1, ">= 0")])
def test_numbers_that_are_not_whole_are_refused(value: float, expected: str) -> None:
    check_whole("steps", 0, allow_zero=True)
    check_whole("steps", 3.0)
    with pytest.raises(ValueError, match=f"steps must be {expected}.*got {value}"):
        check_whole("steps", value, allow_zero=True)


@pytest.mark.parametrize("value", ["abc", None, [1.0], {}])
def test_what_is_no_number_is_named(value: object) -> None:
    with pytest.raises(ValueError, match=f"radius must be a number, got {re.escape(repr(value))}"):
        check_positive("radius", value)  # type: ignore[arg-type]


def test_zero_is_allowed_where_asked_for() -> None:
    check_positive("weight", 0, allow_zero=True)
    check_positive("weight", 5e-324)
    with pytest.raises(ValueError, match="weight must be >= 0 and finite, got -1"):
        check_positive("weight", -1, allow_zero=True)
    with pytest.raises(ValueError, match="got nan"):
        check_positive("weight", math.nan, allow_zero=True)


def test_unknown_choice_is_named_with_the_known_ones() -> None:
    check_choice("kind", "mse", ("mse", "huber"))
    with pytest.raises(ValueError) as error:
        check_choice("kind", "msee", ("mse", "huber"))
    assert str(error.value) == "kind must be one of mse, huber; got 'msee'"


def test_box_is_made_of_nested_lists() -> None:
    box = as_box([[-1, -2, -3], [1, 2, 3]])
    assert box.dtype == torch.float32
    assert box.tolist() == [[-1, -2, -3], [1, 2, 3]]


@pytest.mark.parametrize("corners", [
    [[-1, -1, -1], [1, -1, 1]], [[1, 1, 1], [-1, -1, -1]], [[-1, -1, -1], [1, 1, math.inf]],
    [[-1, math.nan, -1], [1, 1, 1]], [[-1, -1], [1, 1]], [-1, 1],
])  # fmt: skip
def test_boxes_that_are_empty_infinite_or_misshapen_are_refused(corners: list) -> None:
    with pytest.raises(ValueError, match="box must have"):
        as_box(corners)
