"""JSON of others, as untrusted text: files of bounded size to checked numbers. Nothing is executed."""

import json
import math
import stat
from collections.abc import Mapping
from pathlib import Path
from reprlib import Repr
from typing import Any

import numpy as np

from dnerf.data.file_kinds import what_else

MAX_BYTES = 16 * 2**20
MAX_FRAMES = 10_000
MAX_NOTES = 100
MAX_LETTERS = 1000
MAX_SHOWN = 120  # letters of a value in a message
_SHOWN = Repr()
_SHOWN.maxlevel = 2
MAX_NUMBER = 1e9  # keeps sums of squares finite in float32; real scenes lie within thousands


def short(value: Any) -> str:
    """A value in at most 120 letters, for messages."""
    shown = _SHOWN.repr(value)
    return shown if len(shown) <= MAX_SHOWN else shown[: MAX_SHOWN - 3] + "..."


class Notes:
    """What was repaired or ignored, a line each; equal lines are counted."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}

    def add(self, line: str) -> None:
        if line in self._counts or len(self._counts) < MAX_NOTES:
            self._counts[line] = self._counts.get(line, 0) + 1

    def lines(self) -> tuple[str, ...]:
        return tuple(line if count == 1 else f"{line} ({count} times)" for line, count in self._counts.items())


def read_bytes(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """The contents of a regular file of bounded size; ValueError naming it otherwise."""
    try:
        status = path.stat()
        # Opening a pipe would wait for ever.
        if not stat.S_ISREG(status.st_mode):
            raise OSError("not a regular file")
        if status.st_size > max_bytes:
            raise ValueError(f"{path}: file must be at most {max_bytes // 2**20} MiB, got {status.st_size} bytes")
        with path.open("rb") as file:
            return file.read(status.st_size)
    except FileNotFoundError:
        raise ValueError(f"{path}: file does not exist") from None
    except OSError as error:
        raise ValueError(f"{path}: file cannot be read: {error.strerror or error}") from error


def read_object(path: Path) -> dict[str, Any]:
    """The object that a JSON file holds; ValueError in one line that names file and place."""
    data = read_bytes(path)
    try:
        value = json.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        said = what_else(data, "save it as UTF-8")
        raise ValueError(f"{path}: not UTF-8 at byte {error.start}; {said}") from None
    except json.JSONDecodeError as error:
        place = f"line {error.lineno} column {error.colno}"
        said = what_else(data, _remedy(error.doc, error.pos))
        raise ValueError(f"{path}: malformed JSON at {place}: {error.msg}; {said}") from None
    except RecursionError:
        raise ValueError(f"{path}: malformed JSON: nested too deeply") from None
    except ValueError as error:  # an integer of thousands of digits
        raise ValueError(f"{path}: malformed JSON: {error}") from None
    if not isinstance(value, dict):
        raise ValueError(f"{path}: must hold an object, got {short(value)}")
    return value


def _remedy(text: str, place: int) -> str:
    """What to do about text that is no JSON from a place on."""
    found = text[place:].lstrip()
    if found.startswith(("//", "/*", "#")):
        return "JSON has no comments: remove them"
    # Python before 3.13 points at what follows the comma, later ones at the comma.
    if found.lstrip(", \n\r\t").startswith(("]", "}")) and "," in text[:place].rstrip()[-1:] + found[:1]:
        return "remove the comma before the bracket"
    return "correct it there, or export it again"


def required(fields: Mapping[str, Any], key: str, where: str) -> Any:
    """A field that must be there."""
    if fields.get(key) is None:
        raise ValueError(f"{where}.{key} is missing")
    return fields[key]


def number(value: Any, where: str, low: float = -MAX_NUMBER, high: float = MAX_NUMBER) -> float:
    """A number in [low, high]; ValueError naming where it stands otherwise."""
    # bool is an int to Python, not to JSON; and NaN fails the comparison.
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        said = "; write it without quotes" if isinstance(value, str) else ""
        if isinstance(value, float) and not math.isfinite(value):
            said = "; export it again, or take the entry with it out"
        raise ValueError(f"{where} must be a number in [{low:g}, {high:g}], got {short(value)}{said}")
    return float(value)


def whole(value: Any, where: str, low: int, high: int) -> int:
    """A whole number in [low, high], which may be written as 88.0."""
    found = number(value, where, low, high)
    if found != math.floor(found):
        raise ValueError(f"{where} must be a whole number, got {short(value)}")
    return int(found)


def numbers(value: Any, where: str, count: int, low: float = -MAX_NUMBER, high: float = MAX_NUMBER) -> list[float]:
    """A list of so many numbers in [low, high]."""
    if not isinstance(value, list) or len(value) != count:
        raise ValueError(f"{where} must be a list of {count} numbers, got {short(value)}")
    return [number(entry, f"{where}[{index}]", low, high) for index, entry in enumerate(value)]


def matrix(value: Any, where: str, shapes: tuple[tuple[int, int], ...]) -> np.ndarray:
    """A float64 matrix of one of the given shapes, given as a list of rows."""
    for num_rows, num_columns in shapes:
        if not isinstance(value, list) or len(value) != num_rows:
            continue
        if all(isinstance(row, list) and len(row) == num_columns for row in value):
            return np.array([numbers(row, f"{where}[{index}]", num_columns) for index, row in enumerate(value)])
    wanted = " or ".join(f"a list of {rows} lists of {columns} numbers" for rows, columns in shapes)
    raise ValueError(f"{where} must be {wanted}, got {short(value)}")


def text(value: Any, where: str) -> str:
    """Printable text of at most 1000 letters, which is short enough for a path."""
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= MAX_LETTERS:
        raise ValueError(f"{where} must be printable text, got {short(value)}")
    return value
