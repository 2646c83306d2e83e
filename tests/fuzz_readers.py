"""Mutated inputs for everything that reads files of others: data sets, checkpoints, configs of runs.

    python tests/fuzz_readers.py --inputs 100000 [--seed 0] [--readers colmap llff]

A reader may return or raise ValueError in one line; anything else is a failure, as are more than 5 s of processor time
for one input or more than 1 GiB of memory beyond that of a process which has loaded everything. The tests run fewer, by
hypothesis.
"""

import argparse
import json
import math
import os
import random
import resource
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "scripts")]

import data_folders  # noqa: E402
from small_runs import run_of, small_renderer  # noqa: E402

from dnerf.core.cameras import Intrinsics  # noqa: E402
from dnerf.core.lenses import Distortion  # noqa: E402
from dnerf.data import FolderData  # noqa: E402
from dnerf.data.capture import Capture  # noqa: E402
from dnerf.data.formats import read_capture  # noqa: E402
from dnerf.data.loading import load_frames  # noqa: E402
from dnerf.data.scene_record import CameraSet, SceneRecord, World  # noqa: E402
from dnerf.training.checkpoint import encode_run, max_bytes, restore_run  # noqa: E402
from dnerf.training.checkpoint_folder import CheckpointFolder  # noqa: E402
from dnerf.training.runs import load_config  # noqa: E402
from dnerf.training.tensor_files import decode, encode, load_weights, save_weights  # noqa: E402

MAX_SECONDS = 5.0
MAX_MEMORY = 2**30
Reader = Callable[[random.Random], None]  # writes mutated files and reads them
KEYS = [
    "w", "h", "fl_x", "cx", "k1", "k5", "p1", "near", "far", "background", "pixel_origin", "K", "camera_model", "up",
    "is_fisheye", "camera_angle_y", "mask_path", "timestamp", "ply_file_path", "train_filenames", "latlong", "skew",
    "x",
]  # fmt: skip

WEIRD_VALUES: list[Any] = [
    None, True, False, 0, -1, 1, 2, 3.5, 1e-320, 1e308, -1e308, math.nan, math.inf, -math.inf, 2**31, 2**63, -(2**64),
    10**400, "", "0", "..", "../x", "/etc/passwd", "./train/r_0", "C:\\x", "\ud800", "\u0000", "ü" * 300, "a" * 5000,
    [], {}, [[]], [None] * 40, {"a": {}}, [[1.0] * 4] * 4, [[math.nan] * 4] * 4, {"_target_": "os.system"},
    "${oc.env:HOME}",
]  # fmt: skip
TOKENS = [
    b"NaN", b"Infinity", b"-1", b"1e999", b"9" * 5000, b"null", b"true", b"[" * 2000, b"{" * 2000, b'{"a":' * 500,
    b"\\u0000", b"\xff\xfe", b"\xef\xbb\xbf", b"&a ", b"*a", b"!!python/object/apply:os.system ['true']", b"<<: *a",
    b"_target_: os.system", b"${oc.env:HOME}", b"\x00" * 8, b"\xff" * 8, b"IHDR", b"IDAT", b"IEND", b"../",
    b"__metadata__", b"F64", b"data_offsets",
]  # fmt: skip


def mutate_bytes(data: bytes, chance: random.Random) -> bytes:
    """A few random edits of bytes: flips, cuts, repetitions, insertions of what readers look for."""
    result = bytearray(data)
    for _ in range(chance.choice([1, 1, 1, 2, 4, 16])):
        place = chance.randrange(len(result) + 1)
        length = min(chance.choice([1, 1, 2, 4, 8, 64, 1024]), len(result) - place)
        kind = chance.randrange(6)
        if kind == 0 and length:
            result[place] ^= 1 << chance.randrange(8)
        elif kind == 1:
            result[place : place + length] = chance.randbytes(length)
        elif kind == 2:
            del result[place : place + length]
        elif kind == 3:
            result[place:place] = result[place : place + length] * chance.choice([1, 2, 100])
        elif kind == 4:
            result[place : place + chance.choice([0, length])] = chance.choice(TOKENS)
        else:
            del result[place:]
    return bytes(result)


def mutate_json(value: Any, chance: random.Random) -> Any:
    """A value with a random part replaced, removed or repeated."""
    if not isinstance(value, dict | list) or not value or chance.random() > 0.85:
        return chance.choice(WEIRD_VALUES)
    changed: Any = value.copy()
    key = chance.choice(sorted(value)) if isinstance(value, dict) else chance.randrange(len(value))
    kind = chance.randrange(8)
    if kind == 0:
        del changed[key]
    elif kind == 1 and isinstance(changed, list):
        changed += [changed[key]] * chance.choice([1, 5, 300])
    elif kind == 2 and isinstance(changed, dict):
        changed[chance.choice(KEYS)] = chance.choice(WEIRD_VALUES)
    else:
        changed[key] = mutate_json(changed[key], chance)
    return changed


def mutate_png(data: bytes, chance: random.Random) -> bytes:
    """A PNG whose header or chunks are changed, their checksums made good again."""
    chunks, place = [], 8
    while place + 12 <= len(data):
        length = struct.unpack(">I", data[place : place + 4])[0]
        chunks.append((data[place + 4 : place + 8], data[place + 8 : place + 8 + length]))
        place += 12 + length
    index = chance.randrange(len(chunks))
    kind, body = chunks[index]
    how = chance.randrange(5)
    if how == 0:  # another size or kind of pixels
        numbers = [chance.choice([0, 1, 7, 8, 9, 2**14, 2**15, 2**31 - 1, 2**32 - 1]) for _ in range(2)]
        rest = bytes(chance.choice([0, 1, 2, 3, 4, 6, 8, 16, 255]) for _ in range(5))
        kind, body = b"IHDR", struct.pack(">II", *numbers) + chance.choice([rest, data[24:29]])
    elif how == 1 and kind == b"IDAT":  # pixels without end, or of other lengths
        body = zlib.compress(bytes(chance.choice([0, 10, 1000, 2**20])))
    elif how == 2:
        kind = chance.choice([b"tEXt", b"zTXt", b"iTXt", b"iCCP", b"eXIf", b"tRNS", b"PLTE", b"acTL", b"fcTL"])
    elif how == 3:
        chunks.insert(index, chunks[chance.randrange(len(chunks))])
    elif body:
        body = mutate_bytes(body, chance)
    chunks[index] = (kind, body)
    packed = [struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks]
    return data[:8] + b"".join(packed)


def check_capture(capture: Capture, root: Path) -> None:
    """What everything that follows relies on, of a reader's answer to any input."""
    inside = os.path.realpath(root)
    for frames in capture.splits.values():
        assert frames
        assert len({frame.name for frame in frames}) == len(frames)
        timed = {frame.time is None for frame in frames}
        assert len(timed) == 1
        for frame in frames:
            pose = np.array(frame.pose)
            assert pose.shape == (4, 4)
            assert np.isfinite(pose).all()
            assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-3
            assert np.linalg.det(pose[:3, :3]) > 0
            assert frame.time is None or math.isfinite(frame.time)
            for path in (frame.mask, frame.image.path if frame.image else None):
                assert path is None or os.path.commonpath([os.path.realpath(path), inside]) == inside
    assert capture.planes is None or 0 <= capture.planes[0] < capture.planes[1] < math.inf
    assert capture.points is None or bool(capture.points.isfinite().all())
    assert all("\n" not in note for note in capture.notes)


def mutate_binary(data: bytes, chance: random.Random) -> bytes:
    """Bytes of which some are numbers: a count, an index or a float that is out of all bounds, at any place."""
    if chance.random() < 0.5:
        return mutate_bytes(data, chance)
    result = bytearray(data)
    place = chance.choice([0, chance.randrange(len(data)), 8 * chance.randrange(1 + len(data) // 8)])
    layout = chance.choice(["<Q", "<i", "<d"])
    values = {
        "<Q": [0, 1, 2, 255, 2**20, 2**31, 2**40, 2**63, 2**64 - 1], "<i": [0, -1, 1, 5, 10, 2**31 - 1],
        "<d": [0.0, -1.0, 1e-320, 1e30, 1e308, math.nan, math.inf],
    }  # fmt: skip
    packed = struct.pack(layout, chance.choice(values[layout]))
    result[place : place + len(packed)] = packed
    return bytes(result)


def folder_of(write: Callable[[Path], object], *, decode: bool = True) -> Callable[[Path], Reader]:
    """A reader of a folder, one of whose files is spoilt at a time; and of its images, where `decode` says so."""

    def make(folder: Path) -> Reader:
        root = folder / "scene"
        write(root)
        originals = {path: path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}
        images = [path for path in originals if path.suffix in (".png", ".jpg")]
        others = [path for path in originals if path not in images and path.suffix != ".mp4"]

        def read(chance: random.Random) -> None:
            path = chance.choice(images if images and chance.random() < 0.3 else others)
            data = originals[path]
            path.write_bytes(spoilt(path, data, chance))
            try:
                capture = read_capture(root, axes=chance.choice(["auto", "opengl"]))
                check_capture(capture, root)
                for frames in capture.splits.values() if decode else ():
                    load_frames([frame for frame in frames if frame.image], resolution=chance.choice([None, 4]))
                if decode:
                    source = FolderData(root, chance.choice([None, 4]), axes="opengl")
                    assert bool(source.frames("train").poses.isfinite().all())
                    source.record()
            finally:
                path.write_bytes(data)

        return read

    return make


def spoilt(path: Path, data: bytes, chance: random.Random) -> bytes:
    """A file's bytes, changed in a way that its kind invites."""
    if path.suffix == ".json" and chance.random() < 0.75:
        value = json.loads(data)
        for _ in range(chance.choice([1, 1, 2])):
            value = mutate_json(value, chance)
        return json.dumps(value).encode()
    if path.suffix == ".png" and chance.random() < 0.6:
        return mutate_png(data, chance)
    if path.suffix in (".bin", ".npy", ".ply"):
        return mutate_binary(data, chance)
    return mutate_bytes(data, chance)


def write_blender(root: Path) -> None:
    """With a JPEG, a name without suffix, a mask and a test split."""
    data_folders.write_blender(root)
    fields = json.loads((root / "transforms_train.json").read_text())
    Image.open(root / "train/0002.png").convert("RGB").save(root / "train/0002.jpg")
    fields["frames"][2]["file_path"] = "train/0002.jpg"
    fields["frames"][1]["file_path"] = "./train/0001"
    fields["frames"][0]["mask_path"] = "train/0003.png"
    (root / "transforms_train.json").write_text(json.dumps(fields))
    (root / "transforms_test.json").write_text(json.dumps({**fields, "frames": fields["frames"][:2]}))


def write_transforms(root: Path) -> None:
    """With sparse points, masks, lists of names and a lens."""
    data_folders.write_transforms(root)
    fields = json.loads((root / "transforms.json").read_text())
    fields |= {"k1": 0.01, "p1": 0.001, "ply_file_path": "points.ply", "up": [0, 0, 1], "applied_transform": [[1, 0]]}
    fields["train_filenames"] = [frame["file_path"] for frame in fields["frames"]]
    fields["frames"][0]["mask_path"] = "images/0001.png"
    (root / "transforms.json").write_text(json.dumps(fields))
    points = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n" + b"property double x\n"
    points += b"property double y\nproperty double z\nproperty uchar red\nend_header\n"
    (root / "points.ply").write_bytes(points + struct.pack("<3dB3dB", 0.5, 1, 2, 3, 4, 5, 6, 7))


def write_nerfies(root: Path) -> None:
    """With points and what DyCheck adds."""
    data_folders.write_nerfies(root)
    np.save(root / "points.npy", data_folders.POINTS)
    (root / "extra.json").write_text(json.dumps({"up": [0, 0, 1], "fps": 30}))


def mutate_tensors(tensors: dict[str, torch.Tensor], chance: random.Random) -> dict[str, torch.Tensor]:
    """One of them renamed, removed, or given another dtype, size or value."""
    name = chance.choice(sorted(tensors))
    others = {key: value for key, value in tensors.items() if key != name}
    value, how = tensors[name], chance.randrange(6)
    if how == 0:
        return {**others, name + chance.choice(["x", ".", ""]): value}
    if how == 1:
        return {**others, name: value.to(chance.choice([torch.float64, torch.int8, torch.bool, torch.bfloat16]))}
    if how == 2:
        return {**others, name: value.reshape(-1)[: chance.randrange(value.numel() + 1)]}
    if how == 3:
        noise = torch.tensor(list(chance.randbytes(64)), dtype=torch.uint8)
        raw = value.reshape(-1).view(torch.uint8)
        noise = noise.repeat(-(-raw.numel() // 64))[: raw.numel()]
        return {**others, name: noise.view(value.dtype).reshape(value.shape)}
    if how == 4:
        return {**others, chance.choice(["optimizer.x.step", "optimizer.", "random.", "renderer.", "x" * 4000]): value}
    return others


def mutate_safetensors(data: bytes, chance: random.Random) -> bytes:
    if chance.random() < 0.5:
        return mutate_bytes(data, chance)
    length = int.from_bytes(data[:8], "little")
    header = mutate_bytes(data[8 : 8 + length], chance)  # its length is made good again
    return len(header).to_bytes(8, "little") + header + data[8 + length :]


def checkpoint(folder: Path) -> Reader:
    """A state of training and weights, spoilt as bytes, or as tensors and facts with a good digest."""
    (folder / "checkpoints").mkdir(parents=True)
    run = run_of(small_renderer())
    data = encode_run(run, "frames")
    tensors, facts = decode(data)
    weights, path = folder / "weights.safetensors", folder / "checkpoints/step_00000005.safetensors"
    save_weights(run.renderer, weights)
    original = weights.read_bytes()

    def read(chance: random.Random) -> None:
        kind = chance.randrange(4)
        if kind == 0:
            weights.write_bytes(mutate_safetensors(original, chance))
            load_weights(run.renderer, weights)
        elif kind == 1:
            path.write_bytes(mutate_safetensors(data, chance))
            assert CheckpointFolder(path.parent).read(max_bytes(run)) is not None
        elif kind == 2:
            changed = mutate_json(facts, chance)
            text = json.dumps(changed)
            if "NaN" in text or "Infinity" in text or not isinstance(changed, dict):
                raise ValueError("no facts")  # `encode` refuses those
            restore_run(run, encode(tensors, changed), "mutated", "frames")
        else:
            restore_run(run, encode(mutate_tensors(tensors, chance), facts), "mutated", "frames")

    return read


def record(folder: Path) -> Reader:
    """What a run keeps of its data set."""
    folder.mkdir(parents=True)
    poses = torch.from_numpy(data_folders.poses()).float()
    lens = Intrinsics(8, 6, 9.5, 9.5, distortion=Distortion(radial=(0.01,)))
    world = World(((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
    SceneRecord(world, {"train": CameraSet(poses, torch.zeros(4), (lens,) * 4, tuple("abcd"))}).write(folder)
    originals = {file: file.read_bytes() for file in sorted(folder.iterdir())}

    def read(chance: random.Random) -> None:
        file = chance.choice(list(originals))
        file.write_bytes(spoilt(file, originals[file], chance))
        try:
            SceneRecord.read(folder)
        finally:
            file.write_bytes(originals[file])

    return read


def config(folder: Path) -> Reader:
    """The config of a run."""
    import yaml

    folder.mkdir(parents=True)
    value = {
        "seed": 0,
        "data": {"_target_": "dnerf.data.FolderData", "root": "x", "box": [[-1, -1, -1], [1, 1, 1]]},
        "renderer": {"_target_": "dnerf.rendering.Renderer", "field": {"_target_": "dnerf.fields.NeRFField"}},
    }

    def read(chance: random.Random) -> None:
        text = yaml.safe_dump(mutate_json(value, chance) if chance.random() < 0.5 else value)
        data = text.encode("utf-8", "replace")
        (folder / "config.yaml").write_bytes(data if chance.random() < 0.3 else mutate_bytes(data, chance))
        load_config(folder)

    return read


READERS = {
    "checkpoint": checkpoint, "config": config, "record": record, "blender": folder_of(write_blender),
    "transforms": folder_of(write_transforms), "nerfies": folder_of(write_nerfies),
    "llff": folder_of(data_folders.write_llff), "rig": folder_of(data_folders.write_rig, decode=False),
    "colmap": folder_of(data_folders.write_colmap),
    "colmap text": folder_of(partial(data_folders.write_colmap, binary=False)),
}  # fmt: skip


def read_spoilt(reader: Reader, chance: random.Random) -> str | None:
    """Give a reader one mutated input; what was wrong with its answer, or None."""
    begin = time.process_time()  # other programs are not the reader's fault
    try:
        reader(chance)
    except ValueError as error:
        if "\n" in str(error):
            return f"an error of several lines: {error}"
    except BaseException as error:  # noqa: BLE001
        return f"{type(error).__name__}: {error}"
    seconds = time.process_time() - begin
    return f"{seconds:.1f} s" if seconds > MAX_SECONDS else None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--readers", nargs="+", choices=sorted(READERS), default=sorted(READERS))
    given = parser.parse_args()
    import logging

    logging.disable(logging.WARNING)
    failures, slowest, begin = 0, 0.0, time.perf_counter()
    names = given.readers
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as place:
        readers = {name: READERS[name](Path(place) / name.replace(" ", "_")) for name in names}
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MAX_MEMORY, used + MAX_MEMORY))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for index in range(given.inputs):
            name = names[index % len(names)]
            start = time.process_time()
            problem = read_spoilt(readers[name], random.Random(f"{given.seed}-{index}"))
            slowest = max(slowest, time.process_time() - start)
            if problem:
                failures += 1
                print(f"input {index} ({name}): {problem[:300]}", flush=True)
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(
        f"{given.inputs} inputs in {time.perf_counter() - begin:.0f} s: {failures} failures; "
        f"slowest {slowest:.2f} s; memory grew by at most {grown / 1024:.0f} MiB"
    )
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
