"""Finds what would make a host wait for its device: what CUDA graphs cannot record."""

from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

# Values read, shapes that depend on values, and tensors made of numbers of the host.
WAITS = {"_local_scalar_dense", "nonzero", "masked_select", "unique", "_unique2", "lift_fresh", "is_nonzero", "equal"}


class DeviceWaits(TorchDispatchMode):
    """Collects the names of such operations within a `with` block."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = function.overloadpacket.__name__
        places = [*(args[1] if name in ("index", "index_put", "index_put_", "_index_put_impl_") else ())]
        has_mask = any(p is not None and p.dtype in (torch.bool, torch.uint8) for p in places)
        repeats = name == "repeat_interleave" and kwargs.get("output_size") is None
        if name in WAITS or has_mask or repeats:
            self.found.append(name)
        return function(*args, **kwargs)
