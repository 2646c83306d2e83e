"""Weights survive a round trip; files that do not fit are refused with the model untouched."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from dnerf.fields import NeRFField
from dnerf.nn.encodings import SinusoidalEncoding
from dnerf.nn.parameter_groups import HasTrainingBuffers
from dnerf.training.tensor_files import load_weights, save_weights


class Model(nn.Module, HasTrainingBuffers):
    """A field, an encoding whose window is a saved buffer, a layer used twice, a mask, and what only training needs."""

    def __init__(self, hidden_features: int = 8, view_dependent: bool = False) -> None:
        super().__init__()
        self.field = NeRFField(2, hidden_features, (), position_frequencies=2, view_dependent=view_dependent)
        self.encoding = SinusoidalEncoding(3, 2, window_end=1.0)
        self.coarse = self.fine = nn.Linear(3, 3)
        self.register_buffer("occupied", torch.rand(3, 7) > 0.5)
        self.register_buffer("maxima", torch.rand(3, 7))
        self.register_buffer("transposed", torch.rand(2, 3).T)

    def training_buffers(self) -> tuple[str, ...]:
        return ("maxima",)


def copy_of(model: nn.Module) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in model.state_dict().items()}


def assert_refused(model: nn.Module, path: Path, message: str) -> None:
    before = copy_of(model)
    with pytest.raises(ValueError, match=message) as error:
        load_weights(model, path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    path = tmp_path / "weights.safetensors"
    save_weights(Model(), path)
    return path


def test_what_evaluation_needs_survives_a_round_trip_masks_as_bits(tmp_path: Path) -> None:
    saved, loaded = Model(), Model()
    saved.encoding.set_progress(0.4)
    expected = copy_of(saved) | {"maxima": loaded.maxima.clone()}
    path = tmp_path / "run" / "weights.safetensors"
    save_weights(saved, path)
    load_weights(loaded, path)
    assert expected.keys() == loaded.state_dict().keys()
    assert all(torch.equal(expected[name], value) for name, value in loaded.state_dict().items())
    stored = load_file(path)
    assert stored.keys() == expected.keys() - {"maxima"}
    assert (stored["occupied"].dtype, stored["occupied"].shape) == (torch.uint8, (3,))
    assert [p.name for p in path.parent.iterdir()] == ["weights.safetensors"]


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.99])
def test_truncated_file_is_refused(checkpoint: Path, share: float) -> None:
    whole = checkpoint.read_bytes()
    checkpoint.write_bytes(whole[: int(share * len(whole))])
    assert_refused(Model(), checkpoint, "not a readable safetensors file")


def test_what_is_missing_no_file_or_larger_than_the_model_is_not_read(checkpoint: Path) -> None:
    assert_refused(Model(), checkpoint.with_name("nothing.safetensors"), "no such checkpoint")
    assert_refused(Model(), checkpoint.parent, "no such checkpoint")
    with checkpoint.open("r+b") as file:
        file.truncate(2**40)  # sparse
    assert_refused(Model(), checkpoint, r"does not fit its config: at most \d+ bytes, got 1099511627776")


def test_weights_of_another_origin_have_no_digest_and_are_read(checkpoint: Path) -> None:
    tensors = {name: value + 1 for name, value in load_file(checkpoint).items()}
    save_file(tensors, checkpoint)
    model = Model()
    load_weights(model, checkpoint)
    assert all(torch.equal(tensors[name], value) for name, value in model.named_parameters())


def with_header(header: Any, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


GARBAGE = {
    "zeros": b"\x00" * 100,
    "zip": b"PK\x03\x04 a pickled torch file" * 10,
    "header is not JSON": with_header(b"not json at all"),
    "header is a list": with_header([1, 2, 3]),
    "unknown dtype": with_header({"a": {"dtype": "F99", "shape": [1], "data_offsets": [0, 4]}}, bytes(4)),
    "shape larger than data": with_header({"a": {"dtype": "F32", "shape": [9], "data_offsets": [0, 4]}}, bytes(4)),
}


@pytest.mark.parametrize("content", GARBAGE.values(), ids=GARBAGE)
def test_garbage_is_refused(checkpoint: Path, content: bytes) -> None:
    checkpoint.write_bytes(content)
    assert_refused(Model(), checkpoint, "not a readable safetensors file")


@pytest.mark.parametrize(
    ("model", "edit", "message"),
    [
        ({"hidden_features": 16}, lambda t: t, r"field\.\S+ does not fit its config: expected \(16"),
        ({"view_dependent": True}, lambda t: t, r"does not fit its config: missing \['field\."),
        ({}, lambda t: {**t, "intruder": torch.zeros(1)}, r"unexpected \['intruder'\]"),
        ({}, lambda t: {**t, "encoding.window": t["encoding.window"].double()}, r"window does .*32, got \(2,\) .*64"),
    ],
    ids=["another shape", "missing", "surplus", "another dtype"],
)
def test_weights_that_do_not_fit_are_refused(checkpoint: Path, model: Any, edit: Any, message: str) -> None:
    save_file(edit(load_file(checkpoint)), checkpoint)
    assert_refused(Model(**model), checkpoint, message)
