"""What a piece of code demands of the machine: multiplications and bytes of every operation, counted, not timed."""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from benchmarks.machine import Rates

COUNTED_FREE = ("empty", "new_empty", "empty_like", "empty_strided", "detach", "alias")
"""Operations that touch no memory."""
LAYER = "mkldnn::_linear_pointwise"
"""oneDNN's product, bias and activation in one (`dnerf.kernels.relu_layers`); torch counts no flops of it."""
WEIGHTS_OF = {"dnerf::relu_layers": 1, "dnerf::grid_network": 4}
"""Kernels that run whole networks, for each row of their first argument, and which argument their weights are."""


@dataclass
class Work:
    """What one kind of operation demands.

    Args:
        calls: how often it ran.
        num_bytes: read and written, every operand once per call.
        flops: of matrix products, a multiply-add being two.
        seconds: shortest time at the machine's rates: per call, the longer of arithmetic and traffic.
    """

    calls: int = 0
    num_bytes: float = 0.0
    flops: float = 0.0
    seconds: float = 0.0


class OperationCounter(TorchDispatchMode):
    """Counts every operation that runs while it is active, backward passes and in-place updates included.

    Args:
        rates: of the machine, for the shortest times.
    """

    def __init__(self, rates: Rates) -> None:
        super().__init__()
        self.rates = rates
        self.work: dict[str, Work] = defaultdict(Work)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation and count it."""
        kwargs = kwargs or {}
        result = func(*args, **kwargs)
        name = func._schema.name
        if func.is_view or name.rpartition("::")[2] in COUNTED_FREE:
            return result
        inputs = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        outputs = [x for x in tree_leaves(result) if isinstance(x, Tensor)]
        written_in_place = [
            x
            for argument, value in zip(func._schema.arguments, args)
            if argument.alias_info is not None and argument.alias_info.is_write
            for x in tree_leaves(value)
            if isinstance(x, Tensor)
        ]
        is_in_place = {id(x) for x in written_in_place}
        fresh = [x for x in outputs if id(x) not in is_in_place]
        num_bytes = sum(_touched_bytes(x) for x in (*inputs, *fresh, *written_in_place))
        dtype = inputs[0].dtype if inputs else None
        if name == LAYER:
            flops = 2 * result.numel() * args[0].shape[-1]
        elif name in WEIGHTS_OF:
            weights = args[WEIGHTS_OF[name]]
            flops, dtype = 2 * len(args[0]) * sum(x.numel() for x in weights), weights[0].dtype
        else:
            counter = flop_registry.get(func._overloadpacket)
            flops = 0 if counter is None else counter(*args, **kwargs, out_val=result)
        rate = math.inf if dtype is None else self.rates.flops.get(dtype, math.inf)
        work = self.work[name]
        work.calls += 1
        work.num_bytes += num_bytes
        work.flops += flops
        work.seconds += max(flops / rate, num_bytes / self.rates.bandwidth)
        return result


def _touched_bytes(tensor: Tensor) -> int:
    """Bytes of a tensor's elements; those that an expanded tensor repeats count once."""
    distinct = math.prod(size for size, stride in zip(tensor.shape, tensor.stride()) if stride)
    return distinct * tensor.element_size() if tensor.numel() else 0


def total(work: Mapping[str, Work], names: set[str]) -> Work:
    """Sum over some operations."""
    chosen = [work[name] for name in work if name in names]
    return Work(
        sum(w.calls for w in chosen), sum(w.num_bytes for w in chosen), sum(w.flops for w in chosen),
        sum(w.seconds for w in chosen),
    )  # fmt: skip
