"""Faults that are really caused: a full disk, no permission, data that vanish, a GPU without memory."""

import json
import logging
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from dnerf.backgrounds import ConstantBackground
from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.compositing import FieldOutput
from dnerf.data import SyntheticData, save_blender
from dnerf.fields.base import RadianceField
from dnerf.files import atomic_path, claimed, remove_leftovers, write_text
from dnerf.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.training import Trainer

NOBODY = 65534

# Trains on a disk of 1 MiB, which is filled after the second checkpoint: once it is emptied before the last, once not.
ON_A_FULL_DISK = """
import json, logging, os, pathlib, shutil, sys
logging.basicConfig(level=logging.WARNING)
disk = pathlib.Path(sys.argv[1])
sys.path.insert(0, "tests")
from test_run_state import small_renderer, trainer
from dnerf.data import SyntheticData
from dnerf.logs import JsonLinesLog
from dnerf.run_state import CheckpointFolder
from dnerf.scenes import make_scene

frames = SyntheticData(make_scene("walker"), 12, num_train=4).frames("train")

def train(run, emptied):
    def fill(record, _):
        if record.step == 5:
            with open(disk / "ballast", "wb", buffering=0) as file:
                while file.write(bytes(1024)) == 1024:
                    pass
        if record.step == 9 and emptied:
            (disk / "ballast").unlink()

    def fill_quietly(record, renderer):
        try:
            fill(record, renderer)
        except OSError as error:
            said.append(error.strerror)

    said = []
    try:
        trainer(log_every=1, checkpoint_every=2).fit(
            small_renderer(), frames, callbacks=[fill_quietly, JsonLinesLog(run / "log.jsonl")],
            checkpoints=CheckpointFolder(run / "checkpoints"))
    except OSError as error:
        said.append("ended: " + error.strerror)
    files = sorted(str(path.relative_to(run)) for path in run.rglob("*") if path.is_file())
    steps = [json.loads(line)["step"] for line in open(run / "log.jsonl")]
    return {"said": said, "files": files, "steps": steps}

results = []
for emptied in (True, False):
    run = disk / "run"
    run.mkdir()
    results.append(train(run, emptied))
    shutil.rmtree(run)
print(json.dumps(results))
"""


@pytest.fixture(scope="module")
def on_a_full_disk(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[dict[str, Any]], str]:
    """What the program above says, run in a mount namespace of its own, where a disk of 1 MiB is mounted."""
    disk = tmp_path_factory.mktemp("disk")
    script = f'mount -t tmpfs -o size=1m tmpfs "{disk}" && exec "$@"'
    command = ["unshare", "-rm", "sh", "-c", script, "sh"]
    if not shutil.which("unshare") or subprocess.run([*command, "true"], check=False, capture_output=True).returncode:
        pytest.skip("this system lets nobody mount a small disk")
    command += [sys.executable, "-c", ON_A_FULL_DISK, str(disk)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr


def test_a_full_disk_costs_log_lines_and_checkpoints_but_not_the_run(on_a_full_disk) -> None:
    (result, _), warnings = on_a_full_disk
    assert result["said"] == ["No space left on device"]
    assert result["files"] == [
        "checkpoints/step_00000004.safetensors",
        "checkpoints/step_00000010.safetensors",
        "log.jsonl",
    ]
    assert set(result["steps"]) >= {1, 2, 3, 4, 10}
    assert result["steps"] == sorted(result["steps"])
    assert "step 6: no checkpoint, the last one stays: " in warnings
    assert "No space left on device" in warnings


def test_a_disk_full_to_the_end_is_an_error_with_the_last_good_checkpoints_kept(on_a_full_disk) -> None:
    (_, result), _ = on_a_full_disk
    assert result["said"] == ["No space left on device", "ended: No space left on device"]
    assert result["files"] == [
        "checkpoints/step_00000002.safetensors",
        "checkpoints/step_00000004.safetensors",
        "log.jsonl",
    ]


def as_nobody(work: Any) -> str:
    """What `work()` raises or returns, as text, in a process without a superuser's rights."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            if os.getuid() == 0:
                os.setgid(NOBODY)
                os.setuid(NOBODY)
            text = str(work())
        except OSError as error:
            text = f"{type(error).__name__}: {error}"
        except ValueError as error:
            text = f"ValueError: {error}"
        finally:
            os.write(write, text.encode())
            os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        text = pipe.read()
    os.waitpid(pid, 0)
    return text


def test_a_folder_without_permission_is_named(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    (tmp_path / "run").mkdir(mode=0o555)
    assert "Permission denied" in as_nobody(lambda: write_text(tmp_path / "run" / "x.txt", "text"))
    assert "Permission denied" in as_nobody(lambda: write_text(tmp_path / "run" / "deeper" / "x.txt", "text"))
    assert list((tmp_path / "run").iterdir()) == []


def test_a_checkpoint_without_permission_is_named(tmp_path: Path) -> None:
    from dnerf.checkpoints import load_weights, save_weights

    path = tmp_path / "weights.safetensors"
    save_weights(torch.nn.Linear(1, 1), path)
    path.chmod(0o000)
    for parent in (tmp_path, *tmp_path.parents[:2]):
        parent.chmod(0o755)
    said = as_nobody(lambda: load_weights(torch.nn.Linear(1, 1), path))
    assert said == f"ValueError: {path}: cannot be read (Permission denied)"


def test_a_claimed_folder_is_free_again_when_its_process_is_killed(tmp_path: Path) -> None:
    def hold() -> None:
        with claimed(tmp_path):
            (tmp_path / "held").touch()
            time.sleep(60)

    pid = os.fork()
    if pid == 0:
        hold()
        os._exit(0)
    while not (tmp_path / "held").exists():
        time.sleep(0.01)
    with pytest.raises(ValueError, match="in use by another process"), claimed(tmp_path):
        pass
    os.kill(pid, 9)
    os.waitpid(pid, 0)
    with claimed(tmp_path), claimed(tmp_path.parent):
        pass


def test_a_killed_writer_leaves_the_old_file_and_a_leftover_that_is_found(tmp_path: Path) -> None:
    write_text(tmp_path / "file.txt", "old")
    pid = os.fork()
    if pid == 0:
        with atomic_path(tmp_path / "file.txt") as temporary:
            temporary.write_text("half")
            os.kill(os.getpid(), 9)
    os.waitpid(pid, 0)
    assert (tmp_path / "file.txt").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 2
    (tmp_path / "other.txt").touch()
    remove_leftovers(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file.txt", "other.txt"]


def test_leftovers_are_files_of_the_folder_itself(tmp_path: Path) -> None:
    (tmp_path / ".tmp-folder").mkdir()
    (tmp_path / "target").write_text("mine")
    (tmp_path / ".tmp-link").symlink_to(tmp_path / "target")
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {".tmp-folder", "target", ".tmp-link"}
    remove_leftovers(tmp_path / "not there")


def test_data_that_vanish_during_training_are_not_missed(tmp_path: Path) -> None:
    from dnerf.data import load_blender

    source = SyntheticData(make_scene("static"), 12, num_train=3)
    save_blender({"train": source.frames("train")}, tmp_path / "scene")
    frames = load_blender(tmp_path / "scene", "train")
    renderer = Renderer(Haze(), StratifiedSampler(4), ConstantBackground("white"))
    trainer = Trainer(num_steps=6, num_rays=8, log_every=1, progress_bar=False)
    record = trainer.fit(renderer, frames, callbacks=[lambda *_: shutil.rmtree(tmp_path / "scene", ignore_errors=True)])
    assert record.step == 6
    with pytest.raises(ValueError, match="root must be a data set's folder"):
        load_blender(tmp_path / "scene", "train")


def test_an_output_folder_that_vanishes_comes_back(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    from dnerf.logs import JsonLinesLog
    from dnerf.run_state import CheckpointFolder

    run = tmp_path / "run"
    run.mkdir()
    frames = SyntheticData(make_scene("static"), 12, num_train=2).frames("train")
    renderer = Renderer(Haze(), StratifiedSampler(4), ConstantBackground("white"))
    trainer = Trainer(num_steps=6, num_rays=8, log_every=1, checkpoint_every=2, progress_bar=False)
    vanish = [lambda record, _: record.step == 3 and shutil.rmtree(run), JsonLinesLog(run / "log.jsonl")]
    with caplog.at_level(logging.WARNING):
        trainer.fit(renderer, frames, callbacks=vanish, checkpoints=CheckpointFolder(run / "checkpoints"))
    assert "step 3: JsonLinesLog failed" in caplog.text
    assert len(list((run / "checkpoints").iterdir())) == 2


class Haze(RadianceField):
    """A grey fog that needs as much memory as its points are many.

    Args:
        most: more points than this are too many for an imagined GPU.
    """

    def __init__(self, most: int = 10**9) -> None:
        super().__init__()
        self.most = most
        self.thickness = torch.nn.Parameter(torch.tensor(0.3))
        self.sizes: list[int] = []

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self(positions, positions, times).density

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        self.sizes.append(times.numel())
        if times.numel() > self.most:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        thickness = self.thickness * (1.5 + positions.sin().sum(-1))
        return FieldOutput(thickness, (0.5 + 0.5 * positions.cos()) * torch.ones_like(positions))


def camera() -> Camera:
    return Camera(Intrinsics.from_angle(10, 7, 0.7), look_at((4.0, 0.0, 1.0)))


def test_an_image_too_large_for_the_gpu_is_rendered_in_smaller_chunks(caplog: pytest.LogCaptureFixture) -> None:
    plenty, little = (Renderer(Haze(most), StratifiedSampler(4)) for most in (10**9, 4 * 9))
    expected = plenty.render_image(camera(), 0.5, chunk=70)
    with caplog.at_level(logging.WARNING):
        image = little.render_image(camera(), 0.5, chunk=70)
    assert torch.equal(image.rgb, expected.rgb)
    assert torch.equal(image.depth, expected.depth)
    assert little.field.sizes[:4] == [4 * 70, 4 * 35, 4 * 17, 4 * 8]
    assert set(little.field.sizes[4:-1]) == {4 * 8}  # no chunk that failed is tried again
    assert [record.message.count("chunk") for record in caplog.records] == [1, 1, 1]


def test_a_gpu_without_memory_for_one_ray_is_an_error() -> None:
    with pytest.raises(MemoryError, match="one ray"):
        Renderer(Haze(3), StratifiedSampler(4)).render_image(camera(), 0.5, chunk=8)


def test_training_says_what_to_lower_when_the_gpus_memory_does_not_suffice() -> None:
    frames = SyntheticData(make_scene("static"), 12, num_train=2).frames("train")
    renderer = Renderer(Haze(4 * 100), StratifiedSampler(4), ConstantBackground("white"))
    with pytest.raises(MemoryError, match=r"step 1: .* 200 rays; lower trainer\.num_rays.*bfloat16"):
        Trainer(num_steps=2, num_rays=200, progress_bar=False).fit(renderer, frames)
