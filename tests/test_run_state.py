"""The state of a run: it comes back exactly or not at all, whatever happened to its file."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from dnerf.backgrounds import RandomBackground
from dnerf.checkpoints import decode, encode
from dnerf.data import SyntheticData
from dnerf.deformations import DisplacementDeformation
from dnerf.error_map import ErrorMap
from dnerf.fields import DeformedField, GridField
from dnerf.records import TrainingRecord
from dnerf.renderer import Renderer
from dnerf.run_state import CheckpointFolder, RunState, max_bytes
from dnerf.samplers import OccupancySampler
from dnerf.scenes import make_scene
from dnerf.training import Trainer

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))


@pytest.fixture(scope="module")
def frames():
    return SyntheticData(make_scene("walker"), 12, num_train=4).frames("train")


def small_renderer(seed: int = 0, features: int = 4) -> Renderer:
    torch.manual_seed(seed)
    deformation = DisplacementDeformation(2, 16, (), position_frequencies=3, time_frequencies=2)
    canonical = GridField(BOX, (4, 8), features, hidden_features=8)
    sampler = OccupancySampler(BOX, 0.1, 8, num_slabs=2, update_every=3, num_probes=64, pad_to=64)
    return Renderer(DeformedField(deformation, canonical), sampler, RandomBackground())


def trainer(**changes: Any) -> Trainer:
    settings = {"num_steps": 10, "num_rays": 16, "target_samples": 400, "progress_bar": False, "checkpoint_every": 4}
    settings["orthogonal"] = ["field.deformation"]
    return Trainer(**(settings | changes))


def state_of(renderer: Renderer, step: int = 5) -> RunState:
    optimizer = trainer().optimizer(renderer)
    generator = torch.Generator().manual_seed(4)
    for parameter in renderer.parameters():
        parameter.grad = torch.rand(parameter.shape, generator=generator)
    optimizer.step()
    record = vars(TrainingRecord(step, 1.25, {"loss": 0.1}, 10.0, 37, 300, 0.5))
    return RunState({"renderer": renderer}, optimizer, generator, 37, step, 1.25, 99, record, "frames", begun=0.5)


def contents(state: RunState) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    tensors, facts = decode(state.encode())
    assert facts is not None
    return tensors, facts


def assert_same(a: RunState, b: RunState) -> None:
    (tensors, facts), (others, other_facts) = contents(a), contents(b)
    assert facts == other_facts
    assert tensors.keys() == others.keys()
    assert all(tensors[name].numpy().tobytes() == others[name].numpy().tobytes() for name in tensors)


def test_a_state_comes_back_exactly() -> None:
    saved, restored = state_of(small_renderer(0)), state_of(small_renderer(1), step=9)
    restored.generator.manual_seed(77)
    restored.restore(saved.encode(), "here", max_rays=64)
    assert_same(saved, restored)
    assert restored.step == 5
    assert restored.seconds == 1.25
    assert restored.begun == 0.5
    assert torch.rand(3, generator=saved.generator).equal(torch.rand(3, generator=restored.generator))
    expected = saved.optimizer.state_dict()["state"]
    assert {k: v["step"] for k, v in restored.optimizer.state_dict()["state"].items()} == {
        k: v["step"] for k, v in expected.items()
    }


def test_a_state_of_before_it_said_when_training_began_began_at_once() -> None:
    saved, restored = state_of(small_renderer(0)), state_of(small_renderer(1))
    tensors, facts = contents(saved)
    restored.restore(encode(tensors, {k: v for k, v in facts.items() if k != "begun"}), "here", max_rays=64)
    assert restored.begun == 0.0


def test_a_state_has_all_that_training_changes() -> None:
    state = state_of(small_renderer())
    tensors, facts = contents(state)
    assert {"renderer.sampler.maxima", "renderer.sampler.occupied", "random.run", "random.cpu"} <= tensors.keys()
    for name, parameter in state.modules["renderer"].named_parameters():
        is_orthogonal = "deformation.mlp.hidden" in name and parameter.ndim == 2
        keys = {"step", "exp_avg"} if is_orthogonal else {"step", "exp_avg", "exp_avg_sq"}
        assert {f"optimizer.{name}.{key}" for key in keys} == {n for n in tensors if n.startswith(f"optimizer.{name}.")}
    assert facts.keys() == {
        "format",
        "device",
        "step",
        "seconds",
        "begun",
        "num_rays",
        "rays_done",
        "rollbacks",
        "record",
        "data",
    }


@pytest.mark.parametrize("stop", [1, 4, 7, 9])
@pytest.mark.parametrize("guided", [False, True])
def test_training_in_two_parts_is_training_in_one(frames, tmp_path: Path, stop: int, guided: bool) -> None:
    def begun(**changes: Any) -> Trainer:
        return trainer(error_map=ErrorMap(share=0.5, resolution=4) if guided else None, **changes)

    whole, parts = small_renderer(), small_renderer()
    expected = begun().fit(whole, frames, seed=2, checkpoints=CheckpointFolder(tmp_path / "whole"))

    class Stop(Exception):
        pass

    def stop_at(record: Any, _: Any) -> None:
        if record.step == stop:
            raise Stop

    folder = tmp_path / "parts"
    with pytest.raises(Stop):
        begun(log_every=1).fit(parts, frames, seed=2, callbacks=[stop_at], checkpoints=CheckpointFolder(folder))
    torch.rand(5)  # the process has gone on to other things
    again = small_renderer(seed=8)
    record = begun().fit(again, frames, seed=3, checkpoints=CheckpointFolder(folder), resume=True)
    if stop > 4:
        for name, value in whole.state_dict().items():
            assert torch.equal(value, again.state_dict()[name]), name
        assert record.losses == expected.losses
        assert record.num_rays == expected.num_rays
    else:  # no checkpoint yet: another seed began anew
        assert not torch.equal(whole.state_dict()["sampler.maxima"], again.state_dict()["sampler.maxima"])


def test_the_newest_and_the_good_one_before_it_are_kept(tmp_path: Path) -> None:
    folder, state = CheckpointFolder(tmp_path), state_of(small_renderer())
    for state.step in (1, 2, 3, 4):
        folder.save(state)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "step_00000003.safetensors",
        "step_00000004.safetensors",
    ]


def limit(state: RunState) -> int:
    return max_bytes(state.modules)


def test_a_damaged_checkpoint_is_passed_over_and_the_good_one_outlives_it(tmp_path: Path, caplog) -> None:
    state, folder = state_of(small_renderer()), CheckpointFolder(tmp_path)
    for state.step in (1, 2):
        folder.save(state)
    newest = tmp_path / "step_00000002.safetensors"
    newest.write_bytes(newest.read_bytes()[:-1])
    folder = CheckpointFolder(tmp_path)
    data = folder.read(limit(state))
    assert data == (tmp_path / "step_00000001.safetensors").read_bytes()
    assert "step_00000002.safetensors: not a readable safetensors file" in caplog.text
    state.step = 3
    folder.save(state)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["step_00000001.safetensors", "step_00000003.safetensors"]


def test_no_checkpoint_is_none_and_only_damaged_ones_are_an_error(tmp_path: Path) -> None:
    state = state_of(small_renderer())
    assert CheckpointFolder(tmp_path / "nothing").read(limit(state)) is None
    (tmp_path / "step_00000002.safetensors").write_bytes(b"nonsense")
    (tmp_path / "step_00000003.safetensors").mkdir()
    with pytest.raises(ValueError, match=r"no checkpoint can be read; .*step_00000003\.safetensors"):
        CheckpointFolder(tmp_path).read(limit(state))


def test_a_file_larger_than_the_model_allows_is_not_read(tmp_path: Path) -> None:
    state = state_of(small_renderer())
    with (tmp_path / "step_00000002.safetensors").open("wb") as file:
        file.truncate(2**40)  # sparse
    with pytest.raises(ValueError, match="at most"):
        CheckpointFolder(tmp_path).read(limit(state))
    CheckpointFolder(tmp_path / "good").save(state)
    assert CheckpointFolder(tmp_path / "good").read(limit(state)) is not None


def byte_ranges(data: bytes) -> list[tuple[str, int, int]]:
    """Name, begin and end of everything a file consists of: header length, header, each tensor."""
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    ranges = [("length", 0, 8), ("header", 8, 8 + length)]
    for name, entry in header.items():
        if name != "__metadata__":
            begin, end = entry["data_offsets"]
            ranges.append((name, 8 + length + begin, 8 + length + end))
    return ranges


def test_a_flipped_byte_anywhere_is_noticed_or_changes_nothing() -> None:
    state, data = state_of(small_renderer()), state_of(small_renderer()).encode()
    expected = contents(state)
    covered, noticed = 0, 0
    for _, begin, end in byte_ranges(data):
        step = max(1, (end - begin) // 12)
        for place in {*range(begin, end, step), end - 1} if end > begin else ():
            broken = bytearray(data)
            broken[place] ^= (0x01, 0x80, 0xFF)[covered % 3]
            covered += 1
            try:
                tensors, facts = decode(bytes(broken))
            except ValueError:
                noticed += 1
                continue
            # A file whose name for the digest is destroyed is one of another origin: no checkpoint.
            assert facts is None or facts == expected[1]
            assert tensors.keys() == expected[0].keys() or facts is None
            if facts is not None:
                assert all(torch.equal(tensors[name], expected[0][name]) for name in tensors)
    assert covered > 300
    assert noticed > 0.97 * covered


Edit = Callable[[dict[str, torch.Tensor], dict[str, Any]], object]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda t, f: f.update(format=2), "format 1"),
        (lambda t, f: f.update(device="cuda"), "device must be cuda"),
        (lambda t, f: f.update(step=-1), "step"),
        (lambda t, f: f.update(step=True), "step"),
        (lambda t, f: f.update(step=2**60), "step"),
        (lambda t, f: f.pop("seconds"), "seconds"),
        (lambda t, f: f.update(seconds="1"), "seconds"),
        (lambda t, f: f.update(begun=-1.0), "begun"),
        (lambda t, f: f.update(num_rays=10**12), "num_rays"),
        (lambda t, f: f.update(num_rays=0), "num_rays"),
        (lambda t, f: f.update(rays_done=1.5), "rays_done"),
        (lambda t, f: f.update(record=[1]), "record"),
        (lambda t, f: f["record"].pop("psnr"), "record must be an object with"),
        (lambda t, f: f["record"].update(losses=3), "record must be an object with"),
        (lambda t, f: f["record"].update(psnr="high"), "record.psnr must be a number"),
        (lambda t, f: f["record"]["losses"].update(rgb=None), "record.rgb must be a number"),
        (lambda t, f: f.update(data="others"), "training frames"),
        (lambda t, f: t.pop("random.run"), "missing"),
        (lambda t, f: t.pop("renderer.sampler.maxima"), "missing"),
        (lambda t, f: t.update(intruder=torch.zeros(1)), "unexpected"),
        (lambda t, f: t.update({"random.run": torch.zeros(3, dtype=torch.uint8)}), "random.run"),
        (lambda t, f: t.update({"random.run": torch.full_like(t["random.run"], 255)}), "not the state of a generator"),
        (lambda t, f: t.update({"optimizer.nobody.step": torch.zeros(())}), "optimizer.nobody"),
        (lambda t, f: t.pop(next(n for n in t if n.endswith(".exp_avg"))), "exp_avg"),
        (lambda t, f: t.update({n: torch.zeros(7) for n in t if n.endswith(".exp_avg")}), "exp_avg"),
        (lambda t, f: t.update({n: v.double() for n, v in t.items() if n.endswith(".step")}), "step"),
    ],
)
def test_a_state_that_does_not_fit_is_refused_and_changes_nothing(edit: Edit, message: str) -> None:
    tensors, facts = contents(state_of(small_renderer(1)))
    edit(tensors, facts)
    state = state_of(small_renderer())
    before, drawn = state.encode(), torch.get_rng_state()
    with pytest.raises(ValueError, match=message) as error:
        state.restore(encode(tensors, facts), "file", max_rays=64)
    assert str(error.value).startswith("file: ")
    assert "\n" not in str(error.value)
    torch.set_rng_state(drawn)
    assert state.encode() == before


def test_a_state_without_a_record_is_one_before_the_first() -> None:
    tensors, facts = contents(state_of(small_renderer()))
    facts.pop("record")  # found by fuzzing: KeyError
    state = state_of(small_renderer(1))
    state.restore(encode(tensors, facts), "file", max_rays=64)
    assert state.record is None


def test_a_file_whose_entry_lacks_its_digest_is_refused(tmp_path: Path) -> None:
    from safetensors.torch import save

    for entry in ("{}", '{"facts": "{}"}', '{"digest": "00"}', "[]", "3", "nonsense"):  # found by fuzzing: KeyError
        with pytest.raises(ValueError, match="not a readable safetensors file"):
            decode(save({"a": torch.zeros(2)}, metadata={"dnerf": entry}))


def test_weights_alone_cannot_be_continued(tmp_path: Path) -> None:
    from dnerf.checkpoints import save_weights

    save_weights(small_renderer(), tmp_path / "weights.safetensors")
    with pytest.raises(ValueError, match="weights alone"):
        state_of(small_renderer()).restore((tmp_path / "weights.safetensors").read_bytes(), "file", max_rays=64)


def test_a_state_that_is_not_finite_is_not_saved(tmp_path: Path) -> None:
    state = state_of(small_renderer())
    with torch.no_grad():
        state.modules["renderer"].field.canonical.table.view(-1)[3] = math.nan
    with pytest.raises(FloatingPointError, match=r"step 5: parameters not finite: field\.canonical\.table"):
        CheckpointFolder(tmp_path).save(state)
    assert list(tmp_path.iterdir()) == []


def test_equal_states_are_equal_files() -> None:
    assert state_of(small_renderer()).encode() == state_of(small_renderer()).encode()
