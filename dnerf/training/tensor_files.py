"""Tensors on disk: safetensors with a digest, written atomically, checked before anything is loaded. No pickle."""

import hashlib
import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load, save
from torch import Tensor, nn

from dnerf.core.files import write_bytes
from dnerf.nn.parameter_groups import training_buffer_names

MAX_HEADER = 16 * 2**20  # bytes of a file beyond its tensors
ENTRY = "dnerf"  # of the file's metadata: facts and digest


def encode(tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> bytes:
    """Tensors and JSON values as one safetensors file; a SHA-256 digest of both goes with them.

    Raises:
        ValueError: if a fact has no JSON form (NaN, infinity).
    """
    # Copies, because the format refuses tensors that share memory, as modules used twice in a model do.
    copies = {k: v.detach().cpu().clone(memory_format=torch.contiguous_format) for k, v in tensors.items()}
    text = json.dumps(facts, allow_nan=False, sort_keys=True)
    # One entry, because the format writes several in any order, and equal contents shall give equal files.
    return save(copies, metadata={ENTRY: json.dumps({"digest": _digest(copies, text), "facts": text})})


def decode(data: bytes, where: object = "data") -> tuple[dict[str, Tensor], dict[str, Any] | None]:
    """Tensors and facts of `encode`; facts are None in a safetensors file of another origin, which has no digest.

    Raises:
        ValueError: naming `where`, if the data are damaged, in any byte that carries meaning.
    """
    try:
        tensors = load(data)
        length = int.from_bytes(data[:8], "little")
        entry = (json.loads(data[8 : 8 + length]).get("__metadata__") or {}).get(ENTRY)
        if entry is None:
            return tensors, None
        stated = json.loads(entry)
        text = str(stated["facts"])
        if stated["digest"] != _digest(tensors, text):
            raise ValueError("damaged: its contents do not match their digest")
        facts = json.loads(text)
        if not isinstance(facts, dict):
            raise ValueError(f"facts must be an object, got {type(facts).__name__}")
    # A decoder given hostile bytes raises many types (SafetensorError, KeyError, RuntimeError of unusual dtypes, ...).
    except Exception as error:
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(f"{where}: not a readable safetensors file ({said})") from error
    return tensors, facts


def read_limited(path: Path, max_bytes: int) -> bytes:
    """The contents of a regular file that is not larger than expected.

    Raises:
        ValueError: naming the file, if it is missing, larger, or not a file that can be read.
    """
    try:
        status = os.stat(path)
        # Opening a pipe would wait for ever.
        if not stat.S_ISREG(status.st_mode):
            raise ValueError(f"{path}: no such checkpoint, it is not a file")
        if status.st_size > max_bytes:
            raise ValueError(f"{path}: does not fit its config: at most {max_bytes} bytes, got {status.st_size}")
        with open(path, "rb") as file:
            return file.read(max_bytes + 1)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such checkpoint") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error


def check_fit(expected: Mapping[str, Tensor], found: Mapping[str, Tensor], where: object) -> None:
    """Compare names, shapes and dtypes of tensors.

    Raises:
        ValueError: naming `where` and the first tensors that do not fit.
    """
    missing, surplus = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    if missing or surplus:
        raise ValueError(f"{where}: does not fit its config: missing {missing[:3]}, unexpected {surplus[:3]}")
    for name, value in expected.items():
        if value.shape != found[name].shape or value.dtype != found[name].dtype:
            raise ValueError(
                f"{where}: {name} does not fit its config: expected {tuple(value.shape)} {value.dtype}, "
                f"got {tuple(found[name].shape)} {found[name].dtype}"
            )


def save_weights(model: nn.Module, path: Path) -> None:
    """Write what a model needs in evaluation mode to `path` (safetensors), masks as bits."""
    write_bytes(path, encode({name: _packed(value) for name, value in _weights(model).items()}, {}))


def load_weights(model: nn.Module, path: Path) -> None:
    """Load weights written by `save_weights`; the model is untouched unless all of them fit.

    Raises:
        ValueError: naming the file, if it is missing, damaged, or does not fit the model.
    """
    weights = _weights(model)
    expected = {name: _packed(value) for name, value in weights.items()}
    tensors, _ = decode(read_limited(path, num_bytes(expected) + MAX_HEADER), path)
    check_fit(expected, tensors, path)
    unpacked = {name: _unpacked(tensors[name], value) for name, value in weights.items()}
    model.load_state_dict({**model.state_dict(), **unpacked})


def _weights(model: nn.Module) -> dict[str, Tensor]:
    left_out = training_buffer_names(model)
    return {name: value for name, value in model.state_dict().items() if name not in left_out}


def _packed(value: Tensor) -> Tensor:
    """A mask as bits in bytes (n,), anything else as it is."""
    if value.dtype != torch.bool:
        return value
    return torch.from_numpy(np.packbits(value.detach().cpu().numpy().reshape(-1)))


def _unpacked(stored: Tensor, like: Tensor) -> Tensor:
    """What `_packed` made `stored` of."""
    if like.dtype != torch.bool:
        return stored
    return torch.from_numpy(np.unpackbits(stored.numpy(), count=like.numel())).bool().view(like.shape)


def num_bytes(tensors: Mapping[str, Tensor]) -> int:
    """Memory of tensors, those that share it counted each."""
    return sum(value.numel() * value.element_size() for value in tensors.values())


def _digest(tensors: Mapping[str, Tensor], text: str) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        value = tensors[name]
        digest.update(f"\0{name}\0{value.dtype}\0{tuple(value.shape)}\0".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
