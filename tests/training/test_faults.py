"""Faults that are really caused: a full disk, no permission, data that vanish, a GPU without memory."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from data_folders import frames_of
from small_runs import Watch, small_frames, small_renderer, small_trainer
from torch import Tensor

from dnerf.core.backgrounds import ConstantBackground
from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.compositing import FieldOutput
from dnerf.core.files import atomic_path, claimed, remove_leftovers, write_text
from dnerf.data import save_blender
from dnerf.fields.base import RadianceField
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.training import Checkpoints, JsonLinesLog, Trainer
from dnerf.training.tensor_files import load_weights, save_weights

NOBODY = 65534

# Trains on a disk of 1 MiB, which is filled after the second checkpoint: once it is emptied before the last, once not.
ON_A_FULL_DISK = """
import json, logging, pathlib, shutil, sys
logging.basicConfig(level=logging.WARNING)
disk = pathlib.Path(sys.argv[1])
sys.path.insert(0, "tests")
from small_runs import Watch, small_frames, small_renderer, small_trainer
from dnerf.training import Checkpoints, JsonLinesLog

def train(run, emptied):
    said = []

    def fill(at):
        if at.step == 9 and emptied:
            (disk / "ballast").unlink()
        if at.step == 5:
            try:
                with open(disk / "ballast", "wb", buffering=0) as file:
                    while file.write(bytes(1024)) == 1024:
                        pass
            except OSError as error:
                said.append(error.strerror)

    callbacks = {"fill": Watch(fill), "log": JsonLinesLog(), "checkpoints": Checkpoints(2)}
    try:
        small_trainer(log_every=1, callbacks=callbacks).fit(small_renderer(), small_frames(), folder=run)
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


def test_a_full_disk_costs_lines_and_checkpoints_and_the_run_only_if_it_is_full_to_the_end(tmp_path: Path) -> None:
    """The program above, run in a mount namespace of its own, where a disk of 1 MiB is mounted."""
    script = f'mount -t tmpfs -o size=1m tmpfs "{tmp_path}" && exec "$@"'
    command = ["unshare", "-rm", "sh", "-c", script, "sh"]
    if not shutil.which("unshare") or subprocess.run([*command, "true"], check=False, capture_output=True).returncode:
        pytest.skip("this system lets nobody mount a small disk")
    command += [sys.executable, "-c", ON_A_FULL_DISK, str(tmp_path)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    emptied, full = json.loads(done.stdout)
    assert emptied["said"] == ["No space left on device"]
    assert full["said"] == ["No space left on device", "ended: No space left on device"]
    for result, steps in ((emptied, (4, 10)), (full, (2, 4))):
        assert result["files"] == [*(f"checkpoints/step_{step:08d}.safetensors" for step in steps), "log.jsonl"]
    assert set(emptied["steps"]) >= {1, 2, 3, 4, 10}
    assert emptied["steps"] == sorted(emptied["steps"])
    assert "step 6: no checkpoint, the last one stays: " in done.stderr
    assert "No space left on device" in done.stderr


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
        except (OSError, ValueError) as error:
            text = f"{type(error).__name__}: {error}"
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
    path = tmp_path / "weights.safetensors"
    save_weights(torch.nn.Linear(1, 1), path)
    path.chmod(0o000)
    for parent in (tmp_path, *tmp_path.parents[:2]):
        parent.chmod(0o755)
    said = as_nobody(lambda: load_weights(torch.nn.Linear(1, 1), path))
    assert said == f"ValueError: {path}: cannot be read (Permission denied)"


def test_a_claimed_folder_is_free_again_when_its_process_is_killed(tmp_path: Path) -> None:
    pid = os.fork()
    if pid == 0:
        with claimed(tmp_path):
            (tmp_path / "held").touch()
            time.sleep(60)
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
    (tmp_path / ".tmp-folder").mkdir()
    (tmp_path / ".tmp-link").symlink_to(tmp_path / "file.txt")
    remove_leftovers(tmp_path)  # files of the folder itself
    assert {path.name for path in tmp_path.iterdir()} == {"file.txt", ".tmp-folder", ".tmp-link"}
    remove_leftovers(tmp_path / "not there")


def test_data_that_vanish_during_training_are_not_missed(tmp_path: Path) -> None:
    save_blender({"train": small_frames(3)}, tmp_path / "scene")
    vanish = Watch(lambda run: shutil.rmtree(tmp_path / "scene", ignore_errors=True))
    made = small_trainer(num_steps=3, callbacks={"vanish": vanish})
    assert made.fit(small_renderer(), frames_of(tmp_path / "scene", "train")).step == 3
    with pytest.raises(ValueError, match="root must be a data set's folder"):
        frames_of(tmp_path / "scene", "train")


def test_an_output_folder_that_vanishes_comes_back(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = tmp_path / "run"
    vanish = Watch(lambda at: at.step == 3 and shutil.rmtree(run))
    callbacks = {"vanish": vanish, "log": JsonLinesLog(), "checkpoints": Checkpoints(2)}
    small_trainer(num_steps=6, log_every=1, callbacks=callbacks).fit(small_renderer(), small_frames(), folder=run)
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


CAMERA = Camera(Intrinsics.from_angle(10, 7, 0.7), look_at((4.0, 0.0, 1.0)))


def test_an_image_too_large_for_the_gpu_is_rendered_in_smaller_chunks(caplog: pytest.LogCaptureFixture) -> None:
    plenty, little = (Renderer(Haze(most), StratifiedSampler(4)) for most in (10**9, 4 * 9))
    expected = plenty.render_image(CAMERA, 0.5, chunk=70)
    image = little.render_image(CAMERA, 0.5, chunk=70)
    assert torch.equal(image.rgb, expected.rgb)
    assert torch.equal(image.depth, expected.depth)
    assert little.field.sizes[:4] == [4 * 70, 4 * 35, 4 * 17, 4 * 8]
    assert set(little.field.sizes[4:-1]) == {4 * 8}  # no chunk that failed is tried again
    assert [record.message.count("chunk") for record in caplog.records] == [1, 1, 1]


def test_a_gpu_without_memory_for_one_ray_is_an_error() -> None:
    with pytest.raises(MemoryError, match="one ray"):
        Renderer(Haze(3), StratifiedSampler(4)).render_image(CAMERA, 0.5, chunk=8)


def test_training_says_what_to_lower_when_the_gpus_memory_does_not_suffice() -> None:
    renderer = Renderer(Haze(4 * 100), StratifiedSampler(4), ConstantBackground("white"))
    with pytest.raises(MemoryError, match=r"step 1: .* 200 rays; lower trainer\.num_rays.*bfloat16"):
        Trainer(num_steps=2, num_rays=200).fit(renderer, small_frames())
