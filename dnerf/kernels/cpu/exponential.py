# mypy: disable-error-code="call-arg"
"""Exponentials in single precision as part of a loop: calls of the C library's make it put its registers aside.

Source: Cephes' expf (Moshier): x = n ln 2 + r, e^x = 2^n (1 + r + r^2 P(r)); within 2 units in the last place. NaN
stays NaN.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from .launch import BORROWS

LOWEST, HIGHEST = np.float32(-87), np.float32(88)  # powers of two that are normal numbers
LOG2_E = np.float32(1.44269504088896341)
LN2_HIGH, LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
P5, P4, P3, P2, P1, P0 = (
    np.float32(p) for p in (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 0.5)
)
ROUNDS = np.float32(3 << 22)  # added and taken away again, it rounds to whole numbers
BIAS, FRACTION_BITS = 127, 23


@intrinsic
def _power_of_two(typing: Any, exponent: Any) -> tuple[Any, Any]:
    """2^n for a float32 n, a whole number from -126 to 127."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(32)  # numba's own sums of such are of 64 bits, of which vectors hold half as many
        bits = builder.shl(builder.add(builder.fptosi(arguments[0], word), word(BIAS)), word(FRACTION_BITS))
        return builder.bitcast(bits, ir.FloatType())

    return types.float32(types.float32), generate


@njit(forceinline=True, **BORROWS)
def _parts(x: Any) -> Any:
    """2^n and e^r - 1 for a float32; arguments beyond e^-87 and e^88 count as those."""
    x = LOWEST if x < LOWEST else x
    x = HIGHEST if x > HIGHEST else x
    n = (x * LOG2_E + ROUNDS) - ROUNDS
    r = (x - n * LN2_HIGH) - n * LN2_LOW
    polynomial = ((((P5 * r + P4) * r + P3) * r + P2) * r + P1) * r + P0
    return _power_of_two(n), r + r * r * polynomial


@njit(forceinline=True, **BORROWS)
def exp(x: Any) -> Any:
    """e^x of a float32, at least e^-87 and at most e^88."""
    power, rest = _parts(x)
    return power + power * rest


@njit(forceinline=True, **BORROWS)
def expm1(x: Any) -> Any:
    """e^x - 1 of a float32, right to the last places near zero too."""
    power, rest = _parts(x)
    return (power - np.float32(1)) + power * rest


@njit(forceinline=True, **BORROWS)
def sigmoid(x: Any) -> Any:
    """1 / (1 + e^-x) of a float32."""
    return np.float32(1) / (np.float32(1) + exp(-x))
