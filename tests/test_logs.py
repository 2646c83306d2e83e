"""The log of a run that was continued reads as if it had never stopped."""

import json
from pathlib import Path

import pytest
import torch

from dnerf.logs import JsonLinesLog
from dnerf.records import TrainingRecord

MODEL = torch.nn.Identity()


def record(step: int, loss: float = 0.5) -> TrainingRecord:
    return TrainingRecord(step, 0.1 * step, {"loss": loss}, 20.0, 64, 1000, 1.0)


def steps(path: Path) -> list[int]:
    return [json.loads(line)["step"] for line in path.read_text().splitlines()]


def test_records_are_appended(tmp_path: Path) -> None:
    log = JsonLinesLog(tmp_path / "log.jsonl")
    for step in (1, 5, 10):
        log(record(step), MODEL)
    assert steps(tmp_path / "log.jsonl") == [1, 5, 10]
    assert json.loads((tmp_path / "log.jsonl").read_text().splitlines()[1]) == vars(record(5))


@pytest.mark.parametrize("tail", ["", '{"step": 20, "secon', "\x00\x00\n", '{"loss": 3}\n', "[20]\n"])
def test_a_continued_log_replaces_what_came_after_the_checkpoint_and_broken_lines(tmp_path: Path, tail: str) -> None:
    path = tmp_path / "log.jsonl"
    for step in (1, 5, 10, 15):
        JsonLinesLog(path)(record(step, 1.0), MODEL)
    path.write_text(path.read_text() + tail)
    log = JsonLinesLog(path)
    for step in (10, 15):
        log(record(step, 2.0), MODEL)
    assert steps(path) == [1, 5, 10, 15]
    assert [json.loads(line)["losses"]["loss"] for line in path.read_text().splitlines()] == [1.0, 1.0, 2.0, 2.0]


def test_a_link_is_replaced_not_followed(tmp_path: Path) -> None:
    (tmp_path / "outside.txt").write_text("mine")
    (tmp_path / "log.jsonl").symlink_to(tmp_path / "outside.txt")
    JsonLinesLog(tmp_path / "log.jsonl")(record(1), MODEL)
    assert (tmp_path / "outside.txt").read_text() == "mine"
    assert steps(tmp_path / "log.jsonl") == [1]
