"""The exponentials that compiled kernels use."""

import math

import numpy as np
import pytest
from numba import njit

from dnerf.kernels.cpu import exponential


@njit
def values(x):
    out = np.empty((3, len(x)), np.float32)
    for i in range(len(x)):
        out[0, i], out[1, i] = exponential.exp(x[i]), exponential.expm1(x[i])
        out[2, i] = exponential.sigmoid(x[i])
    return out


def test_exponentials_are_right_to_the_last_places():
    x = np.linspace(-86.9, 87.9, 1_000_001, dtype=np.float32)
    exp, expm1, sigmoid = values(x)
    true = x.astype(np.float64)
    unit = np.finfo(np.float32).eps  # two units in the last place, and a half for rounding what is divided
    np.testing.assert_allclose(exp, np.exp(true), rtol=2 * unit)
    np.testing.assert_allclose(expm1, np.expm1(true), rtol=2 * unit)
    np.testing.assert_allclose(sigmoid, 1 / (1 + np.exp(-true)), rtol=2.5 * unit)


def test_small_arguments_keep_their_digits():
    x = np.concatenate([s * np.logspace(-37, -1, 2001) for s in (1, -1)]).astype(np.float32)
    np.testing.assert_allclose(values(x)[1], np.expm1(x.astype(np.float64)), rtol=2 * np.finfo(np.float32).eps)


@pytest.mark.parametrize(("x", "expected"), [
    (0.0, (1, 0, 0.5)), (-0.0, (1, 0, 0.5)),
    (-1e30, (math.exp(-87), -1, math.exp(-88))), (-math.inf, (math.exp(-87), -1, math.exp(-88))),
    (math.inf, (math.exp(88), math.exp(88), 1)),
])  # fmt: skip
def test_ends_of_the_range(x, expected):
    np.testing.assert_allclose(values(np.array([x], np.float32))[:, 0], expected, rtol=1e-6)


def test_nan_stays_nan():
    assert np.isnan(values(np.array([math.nan], np.float32))).all()
