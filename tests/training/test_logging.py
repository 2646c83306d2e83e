"""What a run leaves behind; the log of one that was continued reads as if it had never stopped."""

import json
from pathlib import Path

import pytest
from small_runs import run_of, small_frames, small_renderer, small_trainer

from dnerf.data import SyntheticData
from dnerf.scenes import make_scene
from dnerf.training import Checkpoints, JsonLinesLog, Previews, Run, TrainingRecord


def run_in(folder: Path) -> Run:
    run = run_of(small_renderer(), callbacks={})
    run.folder = folder
    return run


def write(log: JsonLinesLog, run: Run, steps: tuple[int, ...], loss: float = 0.5) -> None:
    log.on_train_begin(run)
    for step in steps:
        run.set_record(TrainingRecord(step, 0.1 * step, {"loss": loss}, 20.0, 64, 1000, 1.0, 0.5, 0.5))
        log.on_step_end(run)
        run.set_record(None)
        log.on_step_end(run)  # no record, no line


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.parametrize("tail", ["", '{"step": 20, "secon', "\x00\x00\n", '{"loss": 3}\n', "[20]\n"])
def test_a_continued_log_replaces_what_came_after_the_checkpoint_and_broken_lines(tmp_path: Path, tail: str) -> None:
    run, log = run_in(tmp_path / "new"), JsonLinesLog("records.jsonl")
    path = tmp_path / "new/records.jsonl"
    write(log, run, (1, 5, 10, 15), 1.0)
    assert lines(path)[-1] == vars(run.last_record)
    path.write_text(path.read_text() + tail)
    write(log, run, (10, 15), 2.0)
    found = [(line["step"], line["losses"]["loss"]) for line in lines(path)]
    assert found == [(1, 1.0), (5, 1.0), (10, 2.0), (15, 2.0)]


def test_a_link_is_replaced_not_followed(tmp_path: Path) -> None:
    (tmp_path / "outside.txt").write_text("mine")
    (tmp_path / "log.jsonl").symlink_to(tmp_path / "outside.txt")
    write(JsonLinesLog(), run_in(tmp_path), (1,))
    assert (tmp_path / "outside.txt").read_text() == "mine"
    assert [line["step"] for line in lines(tmp_path / "log.jsonl")] == [1]


def test_logs_and_previews_of_a_run_and_of_its_continuation(tmp_path: Path) -> None:
    data = SyntheticData(make_scene("walker"), 12, num_val=3)

    def train(num_steps: int) -> None:
        callbacks = {"previews": Previews(data, every=4), "log": JsonLinesLog(), "checkpoints": Checkpoints(None)}
        made = small_trainer(num_steps=num_steps, log_every=3, callbacks=callbacks)
        made.fit(small_renderer(), small_frames(), folder=tmp_path, resume=True)

    train(8)
    train(13)
    # The first record 4 steps after the last image, or after the beginning.
    assert [path.stem for path in sorted((tmp_path / "previews").iterdir())] == ["step_0000006", "step_0000012"]
    assert [line["step"] for line in lines(tmp_path / "log.jsonl")] == [1, 3, 6, 8, 9, 12, 13]


def test_numbers_out_of_range_are_refused() -> None:
    data = SyntheticData(make_scene("walker"), 12)
    with pytest.raises(ValueError, match="every must be > 0"):
        Previews(data, every=0)
    with pytest.raises(ValueError, match="split"):
        Previews(data, split="nothing")
    with pytest.raises(ValueError, match="every must be > 0"):
        Checkpoints(0)
