"""Dealing out tasks to threads as they come free: a core that is slowed down by others holds nobody up."""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def none_taken() -> np.ndarray:
    """The counter that `next_task` wants."""
    return np.zeros(1, np.int64)


@intrinsic
def next_task(typing: Any, taken: Any) -> tuple[Any, Any]:
    """The number of the next task, counted from 0, that no thread has taken."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        counter = context.make_array(taken)(context, builder, arguments[0]).data
        return builder.atomic_rmw("add", counter, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(taken), generate
