"""Mutated inputs for everything that reads files of others: data sets, checkpoints, configs of runs.

    python tests/fuzz_readers.py --inputs 100000 [--seed 0] [--reader checkpoint]

A reader may return or raise ValueError in one line; anything else is a failure, as are more than 5 s of processor time
for one input or more than 1 GiB of memory beyond that of a process which has loaded everything. The tests run fewer, by
hypothesis.
"""

import argparse
import json
import math
import random
import resource
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "scripts")]

import hydra_app  # noqa: E402
from test_run_state import limit, small_renderer, state_of  # noqa: E402

from dnerf.checkpoints import decode, encode, load_weights, save_weights  # noqa: E402
from dnerf.data import load_blender  # noqa: E402
from dnerf.run_state import CheckpointFolder  # noqa: E402

MAX_SECONDS = 5.0
MAX_MEMORY = 2**30

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
            result[place : place + length] = bytes(chance.randrange(256) for _ in range(length))
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
    if isinstance(value, dict | list) and value and chance.random() < 0.85:
        key = chance.choice(sorted(value)) if isinstance(value, dict) else chance.randrange(len(value))
        changed = dict(value) if isinstance(value, dict) else list(value)
        kind = chance.randrange(8)
        if kind == 0:
            del changed[key]  # type: ignore[arg-type]
        elif kind == 1 and isinstance(changed, list):
            changed = changed + [changed[key]] * chance.choice([1, 5, 300])  # type: ignore[index]
        elif kind == 2 and isinstance(changed, dict):
            changed[chance.choice(["w", "h", "fl_x", "cx", "k1", "near", "far", "background", "pixel_origin", "x"])] = (
                chance.choice(WEIRD_VALUES)
            )
        else:
            changed[key] = mutate_json(changed[key], chance)  # type: ignore[index]
        return changed
    return chance.choice(WEIRD_VALUES)


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
        kind, body = (
            chance.choice([b"tEXt", b"zTXt", b"iTXt", b"iCCP", b"eXIf", b"tRNS", b"PLTE", b"acTL", b"fcTL"]),
            body,
        )
    elif how == 3:
        chunks.insert(index, chunks[chance.randrange(len(chunks))])
    else:
        body = mutate_bytes(body, chance) if body else body
    chunks[index] = (kind, body)
    packed = [struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks]
    return data[:8] + b"".join(packed)


class DataSet:
    """A small scene, one of whose files is spoilt at a time."""

    def __init__(self, folder: Path) -> None:
        (folder / "train").mkdir(parents=True)
        self.folder = folder
        pose = [[1.0, 0, 0, 0.5], [0, 1.0, 0, 0], [0, 0, 1.0, 4], [0, 0, 0, 1.0]]
        names = ["./train/r_0", "train/r_1.png", "train/r_2.jpg"]
        self.manifest: dict[str, Any] = {
            "camera_angle_x": 0.7,
            "frames": [{"file_path": n, "time": i / 2, "transform_matrix": pose} for i, n in enumerate(names)],
        }
        pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 4), dtype=np.uint8)
        for index in (0, 1):
            Image.fromarray(pixels).save(folder / "train" / f"r_{index}.png")
        Image.fromarray(pixels[..., :3]).save(folder / "train" / "r_2.jpg")
        self.originals = {path: path.read_bytes() for path in (folder / "train").iterdir()}
        self.path = folder / "transforms_train.json"
        self.originals[self.path] = json.dumps(self.manifest).encode()
        self.path.write_bytes(self.originals[self.path])

    def __call__(self, chance: random.Random) -> None:
        path = chance.choice([self.path, *sorted(self.originals)])
        data = self.originals[path]
        if path == self.path and chance.random() < 0.7:
            value = self.manifest
            for _ in range(chance.choice([1, 1, 2])):
                value = mutate_json(value, chance)
            path.write_bytes(json.dumps(value).encode())
        elif path.suffix == ".png" and chance.random() < 0.6:
            path.write_bytes(mutate_png(data, chance))
        else:
            path.write_bytes(mutate_bytes(data, chance))
        try:
            frames = load_blender(self.folder, "train", chance.choice([None, 4]))
            assert frames.images.dtype == torch.uint8
        finally:
            path.write_bytes(data)


class Checkpoint:
    """A state of training and weights, spoilt as bytes, or as tensors and facts with a good digest."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        self.state = state_of(small_renderer())
        self.data = self.state.encode()
        self.tensors, self.facts = decode(self.data)
        self.weights = folder / "weights.safetensors"
        save_weights(self.state.modules["renderer"], self.weights)
        self.original = self.weights.read_bytes()
        self.folder = folder / "checkpoints"
        self.folder.mkdir()

    def __call__(self, chance: random.Random) -> None:
        kind = chance.randrange(4)
        if kind == 0:
            self.weights.write_bytes(self._spoilt(self.original, chance))
            load_weights(self.state.modules["renderer"], self.weights)
        elif kind == 1:
            path = self.folder / "step_00000005.safetensors"
            path.write_bytes(self._spoilt(self.data, chance))
            assert CheckpointFolder(self.folder).read(limit(self.state)) is not None
        elif kind == 2:
            facts = mutate_json(self.facts, chance)
            text = json.dumps(facts)
            if "NaN" in text or "Infinity" in text or not isinstance(facts, dict):
                raise ValueError("no facts")  # `encode` refuses those
            self.state.restore(encode(self.tensors, facts), "mutated", max_rays=64)
        else:
            tensors = dict(self.tensors)
            name = chance.choice(sorted(tensors))
            value = tensors.pop(name)
            how = chance.randrange(6)
            if how == 0:
                tensors[name + chance.choice(["x", ".", ""])[:1]] = value
            elif how == 1:
                tensors[name] = value.to(chance.choice([torch.float64, torch.int8, torch.bool, torch.bfloat16]))
            elif how == 2:
                tensors[name] = value.reshape(-1)[: chance.randrange(value.numel() + 1)]
            elif how == 3:
                noise = torch.tensor([chance.randrange(256) for _ in range(64)], dtype=torch.uint8)
                raw = value.reshape(-1).view(torch.uint8)
                tensors[name] = (
                    noise.repeat(-(-raw.numel() // 64))[: raw.numel()].view(value.dtype).reshape(value.shape)
                )
            elif how == 4:
                tensors[chance.choice(["optimizer.x.step", "optimizer.", "random.", "renderer.", "x" * 4000])] = value
            self.state.restore(encode(tensors, self.facts), "mutated", max_rays=64)

    @staticmethod
    def _spoilt(data: bytes, chance: random.Random) -> bytes:
        length = int.from_bytes(data[:8], "little")
        if chance.random() < 0.5:  # the header, its length made good again
            header = mutate_bytes(data[8 : 8 + length], chance)
            return len(header).to_bytes(8, "little") + header + data[8 + length :]
        return mutate_bytes(data, chance)


class Config:
    """The config of a run."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        self.folder = folder
        self.path = folder / "config.yaml"
        self.value = {
            "seed": 0,
            "data": {"_target_": "dnerf.data.BlenderData", "root": "x", "box": [[-1, -1, -1], [1, 1, 1]]},
            "renderer": {"_target_": "dnerf.renderer.Renderer", "field": {"_target_": "dnerf.fields.NeRFField"}},
        }

    def __call__(self, chance: random.Random) -> None:
        import yaml

        text = yaml.safe_dump(mutate_json(self.value, chance) if chance.random() < 0.5 else self.value)
        data = text.encode("utf-8", "replace")
        self.path.write_bytes(data if chance.random() < 0.3 else mutate_bytes(data, chance))
        hydra_app.load_config(str(self.folder))


READERS: dict[str, Callable[[Path], Callable[[random.Random], None]]] = {
    "data set": DataSet,
    "checkpoint": Checkpoint,
    "config": Config,
}


def read_spoilt(reader: Callable[[random.Random], None], chance: random.Random) -> str | None:
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
    parser.add_argument("--reader", choices=sorted(READERS), action="append")
    given = parser.parse_args()
    import logging

    logging.disable(logging.WARNING)
    failures, slowest, begin = 0, 0.0, time.perf_counter()
    names = given.reader or sorted(READERS)
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
