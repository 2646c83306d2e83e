"""Weights on disk: safetensors, written atomically, checked against the model before anything is loaded."""

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from dnerf.files import atomic_path


def save_weights(model: nn.Module, path: Path) -> None:
    """Write a model's parameters and buffers to `path` (safetensors)."""
    # Copies, because the format refuses tensors that share memory, as modules used twice in a model do.
    tensors = {
        name: value.detach().cpu().clone(memory_format=torch.contiguous_format)
        for name, value in model.state_dict().items()
    }
    with atomic_path(path) as temporary:
        save_file(tensors, temporary)


def load_weights(model: nn.Module, path: Path) -> None:
    """Load weights written by `save_weights`; the model is untouched unless all of them fit.

    Raises:
        ValueError: naming the file, if it is missing, damaged, or does not fit the model.
    """
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such checkpoint")
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a readable safetensors file ({error})") from error
    expected = model.state_dict()
    missing, surplus = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or surplus:
        raise ValueError(f"{path}: does not fit its config: missing {missing[:3]}, unexpected {surplus[:3]}")
    for name, value in expected.items():
        if value.shape != tensors[name].shape or value.dtype != tensors[name].dtype:
            raise ValueError(
                f"{path}: {name} does not fit its config: expected {tuple(value.shape)} {value.dtype}, "
                f"got {tuple(tensors[name].shape)} {tensors[name].dtype}"
            )
    model.load_state_dict(tensors)
