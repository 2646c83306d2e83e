"""Sparse points of others: PLY files and numpy arrays, without unpickling anything."""

import io
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dnerf.data.formats.json_files import MAX_NUMBER, read_bytes

MAX_BYTES = 2**28
MAX_HEADER = 2**14
MAX_POINTS = 200_000  # more are thinned out evenly
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


def as_points(values: np.ndarray, where: str) -> Tensor | None:
    """Points (N, 3) float32 of an array, those that are finite; None if none is. ValueError for another shape."""
    if values.ndim != 2 or values.shape[1] != 3:
        raise ValueError(f"{where}: points must be an array of N x 3, got {values.shape}")
    values = values[:: max(1, -(-len(values) // MAX_POINTS))].astype(np.float64)
    good = values[(np.abs(values) <= MAX_NUMBER).all(1)]  # false of NaN
    return torch.from_numpy(good).float() if len(good) else None


def read_npy(path: Path, max_bytes: int = MAX_BYTES) -> np.ndarray:
    """A numpy array of floats from a `.npy` file of bounded size; ValueError for anything else, pickles included."""
    data = read_bytes(path, max_bytes)
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0
        }[version]  # fmt: skip
        shape, in_columns, dtype = read_header(file)
    # The header is text that numpy evaluates as a literal: hostile ones raise many types.
    except Exception as error:
        raise ValueError(f"{path}: not a .npy file of version 1 or 2: {' '.join(str(error).split())[:200]}") from error
    if dtype.kind != "f" or dtype.hasobject:
        raise ValueError(f"{path}: must hold floating-point numbers, got {str(dtype)[:80]}; save it as float64")
    count = math.prod(shape)
    if min(shape, default=0) < 0 or count * dtype.itemsize != len(data) - file.tell():
        raise ValueError(f"{path}: must hold {shape} numbers, got {len(data) - file.tell()} bytes of them")
    values = np.frombuffer(data, dtype, count, file.tell())
    return values.reshape(shape, order="F" if in_columns else "C").astype(np.float64)


def read_ply(path: Path) -> Tensor | None:
    """Positions of a PLY file's vertices, which must be its first element; ValueError naming the file otherwise."""
    data = read_bytes(path, MAX_BYTES)
    end = data.find(b"end_header", 0, MAX_HEADER)
    start = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or start == 0:
        raise ValueError(f"{path}: not a PLY file with a header of at most {MAX_HEADER} bytes")
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()]
    form = next((words[1] for words in lines if words[:1] == ["format"] and len(words) > 1), "")
    first = next((i for i, words in enumerate(lines) if words[:1] == ["element"]), None)
    if form not in ORDERS or first is None or len(lines[first]) != 3 or lines[first][1] != "vertex":
        raise ValueError(f"{path}: must have a known format, and vertex as its first element")
    count = int(lines[first][2]) if lines[first][2].isdecimal() and len(lines[first][2]) < 10 else -1
    properties: list[tuple[str, str]] = []
    for words in lines[first + 1 :]:
        if words[:1] == ["element"]:
            break
        if words[:1] == ["property"]:
            properties.append((words[-1], ORDERS[form] + TYPES.get(words[1], "") if len(words) == 3 else ""))
    names = [name for name, _ in properties]
    if not all(kind[-2:] in TYPES.values() for _, kind in properties) or len(set(names)) != len(names):
        raise ValueError(f"{path}: properties of a vertex must be single numbers of known types")
    if count < 0 or not {"x", "y", "z"} <= set(names):
        raise ValueError(f"{path}: vertices must be a number of points with x, y and z")
    if form == "ascii":
        rows = _ascii_rows(path, data[start:], count, len(names))
        return as_points(rows[:, [names.index(axis) for axis in "xyz"]], str(path))
    layout = np.dtype(properties)
    if count * layout.itemsize > len(data) - start:
        raise ValueError(
            f"{path}: must hold {count} vertices of {layout.itemsize} bytes, got {len(data) - start} bytes"
        )
    vertices = np.frombuffer(data, layout, count, start)[:: max(1, -(-count // MAX_POINTS))]
    return as_points(np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], 1), str(path))


def _ascii_rows(path: Path, data: bytes, count: int, width: int) -> np.ndarray:
    """The first rows of text, as many as are kept at most."""
    file, rows = io.BytesIO(data), []
    for index in range(min(count, MAX_POINTS)):
        try:
            row = [float(word) for word in file.readline(MAX_HEADER).split()]
        except ValueError:
            row = []
        if len(row) != width:
            raise ValueError(f"{path}: vertices must be {count} lines of {width} numbers, line {index + 1} is not")
        rows.append(row)
    return np.array(rows).reshape(-1, width)
