"""The state of a run: it comes back exactly or not at all, whatever happened to its file."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from small_runs import BOX, run_of, small_frames, small_renderer, small_trainer, weights

from dnerf.data.pixel_samplers import ErrorGuidedPixels, TemporalCurriculum
from dnerf.losses import PhotometricLoss, UnseenSpaceLoss
from dnerf.training import Callback, CheckpointFolder, Checkpoints, Recovery, Run, Trainer, WeightAverage
from dnerf.training.checkpoint import encode_run, max_bytes, restore_run
from dnerf.training.tensor_files import decode, encode, save_weights


def contents(run: Run) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    tensors, facts = decode(encode_run(run, "frames"))
    assert facts is not None
    return tensors, facts


def test_a_state_comes_back_exactly() -> None:
    saved = run_of(small_renderer(0), callbacks={"recovery": Recovery(), "other": Recovery()})
    saved.callbacks["other"].load_state_dict({"rollbacks": torch.tensor(2)})
    restored = run_of(small_renderer(1), step=9, callbacks={"recovery": Recovery(), "other": Recovery()})
    saved.pixels.errors.mul_(0.3)
    content = encode_run(saved, "frames")
    torch.rand(7, generator=restored.generator)
    restore_run(restored, content, "here", "frames")
    assert encode_run(restored, "frames") == content  # equal states are equal files
    assert (restored.step, restored.seconds, restored.progress) == (5, 1.25, 0.5)
    assert restored.last_record == saved.last_record
    assert restored.callbacks["other"].rollbacks == 2
    assert torch.equal(restored.pixels.errors, saved.pixels.errors)
    assert torch.rand(3, generator=saved.generator).equal(torch.rand(3, generator=restored.generator))


def test_a_state_has_all_that_training_changes() -> None:
    run = run_of(small_renderer())
    tensors, facts = contents(run)
    expected = {"sampler.grid.maxima", "sampler.grid.occupied"} | run.renderer.state_dict().keys()
    assert {f"renderer.{name}" for name in expected} <= tensors.keys()
    assert {"pixels.errors", "callbacks.recovery.rollbacks", "random.run", "random.cpu"} <= tensors.keys()
    for name, parameter in run.renderer.named_parameters():
        is_orthogonal = "deformation.mlp.hidden" in name and parameter.ndim == 2
        keys = {"step", "exp_avg"} if is_orthogonal else {"step", "exp_avg", "exp_avg_sq"}
        assert {f"optimizer.{name}.{key}" for key in keys} == {n for n in tensors if n.startswith(f"optimizer.{name}.")}
    numbers = {"step", "seconds", "progress", "num_rays", "rays_done"}
    assert facts.keys() == numbers | {"format", "device", "record", "data"}


class Counts(Callback):
    """Counts steps, stops the process after one, and breaks the model after another."""

    def __init__(self, stop: int = -1, spoilt: int = -1) -> None:
        self.stop, self.spoilt, self.count = stop, spoilt, 0

    def on_step_end(self, run: Run) -> None:
        self.count += 1
        if run.step == self.spoilt:
            run.renderer.field.canonical.table.data[3] = math.nan

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"count": torch.tensor(self.count)}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        self.count = int(state["count"])

    def on_step_begin(self, run: Run) -> None:
        if run.step == self.stop:
            raise KeyboardInterrupt


def trainer(stop: int = -1, spoilt: int = -1, **changes: Any) -> Trainer:
    """Whatever keeps a state; checkpoints first, which are called last all the same."""
    return small_trainer(
        pixels=ErrorGuidedPixels(TemporalCurriculum(0.5, 0.3), share=0.5, resolution=4),
        losses={"rgb": PhotometricLoss(), "unseen": UnseenSpaceLoss(BOX, every=2, memory_samples=100)},
        callbacks={
            "checkpoints": Checkpoints(4), "recovery": Recovery(), "counts": Counts(stop, spoilt),
            "average": WeightAverage(every=3),
        },
        **({"log_every": 1} | changes),
    )  # fmt: skip


@pytest.mark.parametrize(("stop", "spoilt"), [(4, -1), (7, 3), (9, -1)])
def test_training_in_two_parts_is_training_in_one(tmp_path: Path, stop: int, spoilt: int) -> None:
    whole, parts, again = small_renderer(), small_renderer(), small_renderer(seed=8)
    expected, made = trainer(spoilt=spoilt), trainer()
    last = expected.fit(whole, small_frames(), seed=2, folder=tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        trainer(stop, spoilt).fit(parts, small_frames(), seed=2, folder=tmp_path / "parts")
    torch.rand(5)  # the process has gone on to other things
    record = made.fit(again, small_frames(), seed=3, folder=tmp_path / "parts", resume=True)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
    assert {**vars(record), "seconds": 0} == {**vars(last), "seconds": 0}
    assert made.callbacks["counts"].count == expected.callbacks["counts"].count == 10
    assert made.callbacks["recovery"].rollbacks == expected.callbacks["recovery"].rollbacks == (spoilt > 0)
    files = [(tmp_path / name / "checkpoints/step_00000010.safetensors").read_bytes() for name in ("whole", "parts")]
    (tensors, facts), (others, other_facts) = (decode(file) for file in files)
    assert all(torch.equal(value, others[name]) for name, value in tensors.items() if name != "random.cpu")
    assert {**facts, "seconds": 0, "record": 0} == {**other_facts, "seconds": 0, "record": 0}


def test_a_run_without_a_checkpoint_begins_and_a_finished_one_is_left_as_it_is(tmp_path: Path) -> None:
    first, second = small_renderer(), small_renderer(seed=5)
    record = trainer().fit(first, small_frames(), folder=tmp_path, resume=True)
    assert trainer().fit(second, small_frames(), folder=tmp_path, resume=True) == record
    assert all(torch.equal(value, second.state_dict()[name]) for name, value in first.state_dict().items())


def test_another_model_and_other_data_are_refused(tmp_path: Path) -> None:
    trainer().fit(small_renderer(), small_frames(), folder=tmp_path)
    cases = ((2, [0, 1, 2, 3], "does not fit its config"), (4, [0, 1, 3, 2], "training frames"))
    for features, order, message in cases:
        renderer = small_renderer(features=features)
        before = weights(renderer)
        with pytest.raises(ValueError, match=f"checkpoints: .*{message}"):
            trainer().fit(renderer, small_frames().subset(order), folder=tmp_path, resume=True)
        assert torch.equal(weights(renderer), before)


def test_what_is_not_finite_is_written_neither_on_the_way_nor_at_the_end(tmp_path: Path, caplog) -> None:
    class Spoil(Counts):
        is_required = True  # so that it comes after recovery, before checkpoints

    def made(at: int) -> Trainer:
        callbacks = {"recovery": Recovery(), "spoil": Spoil(spoilt=at), "checkpoints": Checkpoints(4)}
        return small_trainer(log_every=5, callbacks=callbacks)

    made(8).fit(small_renderer(), small_frames(), folder=tmp_path / "on the way")  # recovered at step 10
    said = "step 8: no checkpoint, the last one stays: step 8: parameters not finite: field.canonical.table"
    assert said in caplog.text
    assert [path.name for path in sorted(tmp_path.glob("on*/*/*"))] == [f"step_{i:08d}.safetensors" for i in (4, 10)]
    with pytest.raises(FloatingPointError, match=r"step 10: parameters not finite: field\.canonical\.table"):
        made(10).fit(small_renderer(), small_frames(), folder=tmp_path / "at the end")
    assert [path.name for path in sorted(tmp_path.glob("at*/*/*"))] == [f"step_{i:08d}.safetensors" for i in (4, 8)]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_newest_and_the_good_one_before_it_are_kept(tmp_path: Path, caplog) -> None:
    run = run_of(small_renderer())
    limit, content = max_bytes(run), encode_run(run, "frames")
    folder = CheckpointFolder(tmp_path / "made")
    assert folder.read(limit) is None
    assert not folder.is_begun
    for step in (1, 2, 3):
        folder.save(step, content)
    assert names(folder.folder) == ["step_00000002.safetensors", "step_00000003.safetensors"]
    newest = folder.folder / "step_00000003.safetensors"
    newest.write_bytes(content[:-1])
    again = CheckpointFolder(folder.folder)
    assert again.read(limit) == content  # that of step 2, which outlives the damaged one
    assert "step_00000003.safetensors: not a readable safetensors file" in caplog.text
    again.save(4, content)
    assert names(folder.folder) == ["step_00000002.safetensors", "step_00000004.safetensors"]
    assert again.is_begun


def test_only_damaged_checkpoints_are_an_error_and_large_files_are_not_read(tmp_path: Path) -> None:
    limit = max_bytes(run_of(small_renderer()))
    (tmp_path / "step_00000002.safetensors").write_bytes(b"nonsense")
    (tmp_path / "step_00000003.safetensors").mkdir()
    with pytest.raises(ValueError, match=r"no checkpoint can be read; .*step_00000003\.safetensors"):
        CheckpointFolder(tmp_path).read(limit)
    with (tmp_path / "step_00000004.safetensors").open("wb") as file:
        file.truncate(2**40)  # sparse
    with pytest.raises(ValueError, match="at most"):
        CheckpointFolder(tmp_path).read(limit)


def byte_ranges(data: bytes) -> list[tuple[int, int]]:
    """Begin and end of everything a file consists of: header length, header, each tensor."""
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    tensors = [entry["data_offsets"] for name, entry in header.items() if name != "__metadata__"]
    return [(0, 8), (8, 8 + length), *((8 + length + a, 8 + length + b) for a, b in tensors)]


def test_a_flipped_byte_anywhere_is_noticed_or_changes_nothing() -> None:
    run = run_of(small_renderer())
    data, expected = encode_run(run, "frames"), contents(run)
    covered, said = 0, []
    for begin, end in byte_ranges(data):
        step = max(1, (end - begin) // 12)
        for place in {*range(begin, end, step), end - 1} if end > begin else ():
            broken = bytearray(data)
            broken[place] ^= (0x01, 0x80, 0xFF)[covered % 3]
            covered += 1
            try:
                tensors, facts = decode(bytes(broken))
            except ValueError as error:
                said.append(str(error))
                continue
            # A file whose name for the digest is destroyed is one of another origin: no checkpoint.
            assert facts is None or (facts == expected[1] and tensors.keys() == expected[0].keys())
            assert facts is None or all(torch.equal(tensors[name], value) for name, value in expected[0].items())
    assert covered > 300
    assert len(said) > 0.97 * covered
    assert any("damaged: its contents do not match their digest" in text for text in said)


WRONG_FACTS = {
    "format 2": [("format", 1)], "device must be cuda": [("device", "cuda")], "training frames": [("data", "others")],
    "step": [("step", -1), ("step", True), ("step", 2**60)], "seconds": [("seconds", None), ("seconds", "1")],
    "progress": [("progress", 1.5)], "num_rays": [("num_rays", 10**12), ("num_rays", 0)],
    "rays_done": [("rays_done", 1.5)], "record must be an object with": [("record", [1]), ("record", {"step": 3})],
}  # fmt: skip
OTHER_EDITS = [
    (lambda t, f: f["record"].update(losses=3), "record must be an object with"),
    (lambda t, f: f["record"].update(psnr="high"), "record.psnr must be a number"),
    (lambda t, f: f["record"]["losses"].update(rgb=None), "record.rgb must be a number"),
    (lambda t, f: t.pop("random.run"), "missing"),
    (lambda t, f: t.pop("renderer.sampler.grid.maxima"), "missing"),
    (lambda t, f: t.pop("callbacks.recovery.rollbacks"), "missing"),
    (lambda t, f: t.update(intruder=torch.zeros(1)), "unexpected"),
    (lambda t, f: t.update({"random.run": torch.zeros(3, dtype=torch.uint8)}), "random.run"),
    (lambda t, f: t.update({"random.run": torch.full_like(t["random.run"], 255)}), "not the state of a generator"),
    (lambda t, f: t.update({"optimizer.nobody.step": torch.zeros(())}), "optimizer.nobody"),
    (lambda t, f: t.pop(next(n for n in t if n.endswith(".exp_avg"))), "exp_avg"),
    (lambda t, f: t.update({n: torch.zeros(7) for n in t if n.endswith(".exp_avg")}), "exp_avg"),
    (lambda t, f: t.update({n: v.double() for n, v in t.items() if n.endswith(".step")}), "step"),
]
EDITS = [(lambda t, f, fact=fact: f.update([fact]), said) for said, facts in WRONG_FACTS.items() for fact in facts]


@pytest.mark.parametrize(("edit", "message"), EDITS + OTHER_EDITS)
def test_a_state_that_does_not_fit_is_refused_and_changes_nothing(edit: Callable[..., Any], message: str) -> None:
    tensors, facts = contents(run_of(small_renderer(1)))
    edit(tensors, facts)
    run = run_of(small_renderer())
    before, drawn = encode_run(run, "frames"), torch.get_rng_state()
    with pytest.raises(ValueError, match=message) as error:
        restore_run(run, encode(tensors, facts), "file", "frames")
    assert str(error.value).startswith("file: ")
    assert "\n" not in str(error.value)
    torch.set_rng_state(drawn)
    assert encode_run(run, "frames") == before


def test_a_state_without_a_record_is_one_before_the_first() -> None:
    tensors, facts = contents(run_of(small_renderer()))
    facts.pop("record")  # found by fuzzing: KeyError
    run = run_of(small_renderer(1))
    restore_run(run, encode(tensors, facts), "file", "frames")
    assert run.last_record is None


@pytest.mark.parametrize("entry", ["{}", '{"facts": "{}"}', '{"digest": "00"}', "[]", "3", "nonsense"])
def test_a_file_whose_entry_lacks_its_digest_is_refused(entry: str) -> None:
    from safetensors.torch import save

    with pytest.raises(ValueError, match="not a readable safetensors file"):  # found by fuzzing: KeyError
        decode(save({"a": torch.zeros(2)}, metadata={"dnerf": entry}))


def test_weights_alone_cannot_be_continued(tmp_path: Path) -> None:
    save_weights(small_renderer(), tmp_path / "weights.safetensors")
    content = (tmp_path / "weights.safetensors").read_bytes()
    with pytest.raises(ValueError, match="weights alone"):
        restore_run(run_of(small_renderer()), content, "file", "frames")
