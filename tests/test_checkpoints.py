"""Weights survive a round trip; files that do not fit are refused with the model untouched."""

import json
import struct
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from dnerf.checkpoints import load_weights, save_weights
from dnerf.encodings import SinusoidalEncoding
from dnerf.fields import NeRFField


class Model(nn.Module):
    """A field, and an encoding whose window is a saved buffer."""

    def __init__(self, hidden_features: int = 8, view_dependent: bool = False) -> None:
        super().__init__()
        self.field = NeRFField(2, hidden_features, (), position_frequencies=2, view_dependent=view_dependent)
        self.encoding = SinusoidalEncoding(3, 2, window_end=1.0)


def copy_of(model: nn.Module) -> dict[str, torch.Tensor]:
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


def test_weights_and_buffers_survive_a_round_trip(tmp_path: Path) -> None:
    saved, loaded = Model(), Model()
    saved.encoding.set_progress(0.4)
    path = tmp_path / "run" / "weights.safetensors"
    save_weights(saved, path)
    load_weights(loaded, path)
    expected = copy_of(saved)
    assert expected.keys() == loaded.state_dict().keys()
    assert all(torch.equal(expected[name], value) for name, value in loaded.state_dict().items())
    assert [p.name for p in path.parent.iterdir()] == ["weights.safetensors"]


def test_a_module_used_twice_survives_a_round_trip(tmp_path: Path) -> None:
    def twice() -> nn.Module:
        shared = nn.Linear(3, 3)
        return nn.ModuleDict({"coarse": shared, "fine": shared})

    saved, loaded = twice(), twice()
    save_weights(saved, tmp_path / "weights.safetensors")
    load_weights(loaded, tmp_path / "weights.safetensors")
    assert torch.equal(saved["coarse"].weight, loaded["fine"].weight)  # type: ignore[index]


def test_transposed_and_expanded_tensors_survive_a_round_trip(tmp_path: Path) -> None:
    def views(values: torch.Tensor) -> nn.Module:
        module = nn.Module()
        module.register_buffer("transposed", values.T)
        module.register_buffer("expanded", values[0].expand(4, 3))
        return module

    values = torch.rand(2, 3)
    save_weights(views(values), tmp_path / "weights.safetensors")
    loaded = load_file(tmp_path / "weights.safetensors")
    assert torch.equal(loaded["transposed"], values.T)
    assert torch.equal(loaded["expanded"], values[0].expand(4, 3))


def test_missing_file_is_refused(tmp_path: Path) -> None:
    assert_refused(Model(), tmp_path / "nothing.safetensors", "no such checkpoint")
    assert_refused(Model(), tmp_path, "no such checkpoint")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.99])
def test_truncated_file_is_refused(checkpoint: Path, share: float) -> None:
    whole = checkpoint.read_bytes()
    checkpoint.write_bytes(whole[: int(share * len(whole))])
    assert_refused(Model(), checkpoint, "not a readable safetensors file")


@pytest.mark.parametrize("place", [-1, -100, -700])
def test_a_flipped_byte_among_the_numbers_is_noticed(checkpoint: Path, place: int) -> None:
    data = bytearray(checkpoint.read_bytes())
    data[place] ^= 0x10
    checkpoint.write_bytes(data)
    assert_refused(Model(), checkpoint, "damaged: its contents do not match their digest")


def test_a_file_larger_than_the_model_is_not_read(checkpoint: Path) -> None:
    with checkpoint.open("r+b") as file:
        file.truncate(2**40)  # sparse
    assert_refused(Model(), checkpoint, r"does not fit its config: at most \d+ bytes, got 1099511627776")


def test_weights_of_another_origin_have_no_digest_and_are_read(checkpoint: Path) -> None:
    tensors = load_file(checkpoint)
    save_file({name: value + 1 for name, value in tensors.items()}, checkpoint)
    model = Model()
    load_weights(model, checkpoint)
    assert all(torch.equal(tensors[name] + 1, value) for name, value in model.state_dict().items())


def with_header(header: bytes) -> bytes:
    return struct.pack("<Q", len(header)) + header


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"\x00" * 100, id="zeros"),
        pytest.param(b"\xff" * 100, id="ones"),
        pytest.param(b"PK\x03\x04 a pickled torch file" * 10, id="zip"),
        pytest.param(with_header(b"not json at all"), id="header is not JSON"),
        pytest.param(with_header(b"[1, 2, 3]"), id="header is a list"),
        pytest.param(
            with_header(json.dumps({"a": {"dtype": "F99", "shape": [1], "data_offsets": [0, 4]}}).encode()) + bytes(4),
            id="unknown dtype",
        ),
        pytest.param(
            with_header(json.dumps({"a": {"dtype": "F32", "shape": [9], "data_offsets": [0, 4]}}).encode()) + bytes(4),
            id="shape larger than data",
        ),
    ],
)
def test_garbage_is_refused(checkpoint: Path, content: bytes) -> None:
    checkpoint.write_bytes(content)
    assert_refused(Model(), checkpoint, "not a readable safetensors file")


def test_weights_of_another_shape_are_refused(checkpoint: Path) -> None:
    assert_refused(Model(hidden_features=16), checkpoint, r"field\.\S+ does not fit its config: expected \(16")


def test_missing_weights_are_refused(checkpoint: Path) -> None:
    assert_refused(Model(view_dependent=True), checkpoint, r"does not fit its config: missing \['field\.")


def test_surplus_weights_are_refused(checkpoint: Path) -> None:
    tensors = load_file(checkpoint)
    save_file({**tensors, "intruder": torch.zeros(1)}, checkpoint)
    assert_refused(Model(), checkpoint, r"unexpected \['intruder'\]")


def test_weights_of_another_dtype_are_refused(checkpoint: Path) -> None:
    tensors = load_file(checkpoint)
    save_file({**tensors, "encoding.window": tensors["encoding.window"].double()}, checkpoint)
    assert_refused(Model(), checkpoint, r"encoding\.window does not fit.*float32, got \(2,\) torch\.float64")


def test_failed_save_keeps_the_old_checkpoint(checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = checkpoint.read_bytes()

    def fail(path: Path, data: bytes) -> int:
        path.open("wb").write(data[: len(data) // 2])
        raise OSError("no space left on device")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="no space"):
        save_weights(Model(), checkpoint)
    assert checkpoint.read_bytes() == before
    assert list(checkpoint.parent.iterdir()) == [checkpoint]
