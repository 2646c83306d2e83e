"""A device that is not the CPU, pretended: its tensors refuse to be mixed with those of the CPU, as a GPU's do.

Operations look at where their tensors lie as CUDA's do: all in one place, but for scalars and the places of an index.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing

NAME = "elsewhere"
MOVES = {"_to_copy", "copy_", "_copy_from", "copy"}  # between devices
MAY_INDEX = {"index", "index_put", "index_put_", "_index_put_impl_"}  # with places on the CPU
is_possible = hasattr(backend_registration, "_setup_privateuseone_for_python_backend")


class _Module(backend_registration._DummyBackendModule if is_possible else object):  # type: ignore[misc]
    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16, torch.float16]


class Elsewhere(Tensor):
    """A tensor of the pretended device, and the one on the CPU that holds its values."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> "Elsewhere":
        made = Tensor._make_wrapper_subclass(
            cls, held.shape, held.stride(), held.storage_offset(), dtype=held.dtype, device=f"{NAME}:0"
        )
        made.held = held
        return made

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def new_tensor(self, data: Any, *, dtype: torch.dtype | None = None, device: Any = None) -> Tensor:
        return torch.tensor(data, dtype=dtype or self.dtype, device=device or self.device)

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatched(function, args, kwargs or {})


def _dispatched(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name = function.overloadpacket.__name__
    given: list[Tensor] = []

    def held(x: Tensor) -> Tensor:
        given.append(x)
        return x.held if isinstance(x, Elsewhere) else x

    held_args, held_kwargs = _mapped(held, (args, kwargs))
    is_there = any(isinstance(x, Elsewhere) for x in given)
    wanted = kwargs.get("device")
    if wanted is None and not is_there:
        return function(*args, **kwargs)
    if wanted is not None:
        is_there = torch.device(wanted).type == NAME
    elif is_there and name not in MOVES:
        checked = [args[0]] if name in MAY_INDEX else given
        for x in checked:
            if not isinstance(x, Elsewhere) and x.ndim:
                raise RuntimeError(f"{function}: a tensor {tuple(x.shape)} lies on the {x.device}, others {NAME}")
    elif name == "copy_":
        is_there = isinstance(args[0], Elsewhere)
    if is_there and wanted is not None:
        held_kwargs["device"] = torch.device("cpu")
    outputs = function(*held_args, **held_kwargs)
    if not is_there or name == "_local_scalar_dense":
        return outputs
    outputs = _mapped(Elsewhere, outputs)
    return return_and_correct_aliasing(function, args, kwargs, outputs) if given and _aliases(function) else outputs


@cache
def _aliases(function: Any) -> bool:
    """Whether an operation gives views of its arguments, or changes them."""
    schema = function._schema
    return any(part.alias_info is not None for part in (*schema.arguments, *schema.returns))


def _mapped(change: Callable[[Tensor], Tensor], node: Any) -> Any:
    """The same with each tensor changed (as torch's trees do, which take longer)."""
    if isinstance(node, Tensor):
        return change(node)
    if isinstance(node, tuple | list):
        return type(node)([_mapped(change, child) for child in node])
    return {key: _mapped(change, child) for key, child in node.items()} if isinstance(node, dict) else node


class _Dispatch(TorchDispatchMode):
    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _dispatched(function, args, kwargs or {})


class _Generator(torch.Generator):
    """One on the CPU that says it is elsewhere."""

    def __new__(cls, device: Any = "cpu") -> "_Generator":
        made = super().__new__(cls, "cpu")
        made.is_there = torch.device(device).type == NAME
        return made

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return torch.device(f"{NAME}:0" if self.is_there else "cpu")


def _then_moved(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """`torch.tensor` and `torch.as_tensor`, which pass all dispatching by."""

    def moved(data: Any, *, device: Any = None, **others: Any) -> Tensor:
        made = make(data, **others)
        return made if device is None else made.to(device)

    return moved


@contextmanager
def other_device() -> Iterator[torch.device]:
    """Within a `with` block there is another device, and random generators can be there."""
    if not hasattr(torch, NAME):
        backend_registration._setup_privateuseone_for_python_backend(NAME, backend_module=_Module())
    with (
        _Dispatch(), patch("torch.Generator", _Generator), patch("torch.tensor", _then_moved(torch.tensor)),
        patch("torch.as_tensor", _then_moved(torch.as_tensor)),
    ):  # fmt: skip
        yield torch.device(f"{NAME}:0")
