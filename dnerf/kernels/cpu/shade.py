# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `shade`."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.extending import intrinsic
from torch import Tensor

from ..shade import MOST_LOG_DENSITY
from .exponential import exp, sigmoid
from .launch import BORROWS, array, kernel, launch, next_task, none_taken, num_threads

ROWS = 256  # dealt out to threads
MOST = np.float32(MOST_LOG_DENSITY)


def shade(raw: Tensor, bias: Tensor, log_shift: float) -> tuple[Tensor, Tensor]:
    density, rgb = bias.new_empty(len(raw)), bias.new_empty(len(raw), 3)
    shifts = bias.detach() + bias.new_tensor([log_shift, 0, 0, 0])
    lines = np.zeros((num_threads(), 4, ROWS), np.float32)
    launch(_shade, array(raw), shifts.numpy(), density.numpy(), rgb.numpy(), lines, none_taken())
    return density, rgb


@intrinsic
def single(typing: Any, number: Any) -> tuple[Any, Any]:
    """A float as it is, or the float32 of which a uint16 has the upper half: one in bfloat16."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if number != types.uint16:
            return arguments[0]
        word = ir.IntType(32)
        return builder.bitcast(builder.shl(builder.zext(arguments[0], word), word(16)), ir.FloatType())

    return (types.float32 if number == types.uint16 else number)(number), generate


# No fast-math: NaN stays NaN.
@kernel(**BORROWS)
def _shade(raw: Any, shifts: Any, density: Any, rgb: Any, lines: Any, taken: Any) -> None:
    for worker in prange(len(lines)):
        first = next_task(taken) * ROWS
        while first < len(density):
            count = min(ROWS, len(density) - first)
            line = lines[worker]
            for i in range(count):
                for k in range(4):
                    line[k, i] = single(raw[first + i, k]) + shifts[k]
            logs, found = line[0], density[first : first + count]
            for i in range(len(found)):
                found[i] = exp(MOST if logs[i] > MOST else logs[i])
            for k in range(1, 4):
                values = line[k]
                for i in range(len(values)):
                    values[i] = sigmoid(values[i])
            for i in range(count):
                for k in range(3):
                    rgb[first + i, k] = line[1 + k, i]
            first = next_task(taken) * ROWS
