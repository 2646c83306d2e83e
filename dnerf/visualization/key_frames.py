"""Key frames in a JSON file that a person writes by hand: where the camera is and what time it is, now and then."""

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dnerf.core.cameras import look_at
from dnerf.core.checks import check_choice, check_positive
from dnerf.data.normalization import Similarity
from dnerf.visualization.interpolation import INTERPOLATIONS, interpolate

# Channels of a key frame and their number of values; each is interpolated on its own.
WIDTHS = {"time": 1, "eye": 3, "target": 3, "azimuth": 1, "elevation": 1, "radius": 1, "field_of_view": 1}
DEFAULTS = {"time": (0.0,), "target": (0.0, 0.0, 0.0), "azimuth": (0.0,), "elevation": (25.0,), "radius": (4.0,)}
AROUND = ("azimuth", "elevation", "radius")
MAX_FRAMES = 100_000


@dataclass(frozen=True)
class KeyFrames:
    """Curves through key frames."""

    seconds: tuple[float, float]  # (first, last) of the film
    channels: Mapping[str, tuple[Tensor, Tensor]]  # by name, the seconds (K,) at which it is given, and values (K, C)
    interpolation: str = "smooth"  # "smooth" or "linear"

    def num_frames(self, fps: float) -> int:
        """Frames from the first to the last key frame, both included; ValueError for more than 100 000."""
        check_positive("fps", fps)
        count = round((self.seconds[1] - self.seconds[0]) * fps) + 1
        if count > MAX_FRAMES:
            raise ValueError(f"keyframes last {count} frames at {fps} a second, at most {MAX_FRAMES} are allowed")
        return count

    def in_world(self, similarity: Similarity) -> "KeyFrames":
        """The same film, of key frames that are in a data set's own units."""
        channels = dict(self.channels)
        for name in ("eye", "target"):
            if name in channels:
                channels[name] = channels[name][0], similarity.positions_to_world(channels[name][1])
        if "radius" in channels:
            channels["radius"] = channels["radius"][0], similarity.scale * channels["radius"][1]
        return replace(self, channels=channels)

    def sample(
        self, fps: float, defaults: Mapping[str, Sequence[float]] | None = None
    ) -> tuple[Tensor, list[float], list[float | None]]:
        """Poses (F, 4, 4), times (F) in [0, 1] and horizontal fields of view in radians (F, None: the data's own).

        Args:
            defaults: values of channels that no key frame says, before those of `DEFAULTS`.

        Raises ValueError naming the second, if the eye meets its target or looks straight up or down.
        """
        at = self.seconds[0] + torch.arange(self.num_frames(fps), dtype=torch.float64) / fps
        values = {**DEFAULTS, **(defaults or {})}
        targets = self._curve("target", at, values)
        if "eye" in self.channels:
            eyes = self._curve("eye", at, values)
        else:
            azimuth, elevation, radius = (self._curve(name, at, values)[:, 0] for name in AROUND)
            azimuth, elevation = torch.deg2rad(azimuth), torch.deg2rad(elevation)
            across, up = elevation.cos(), elevation.sin()
            around = torch.stack([across * azimuth.cos(), across * azimuth.sin(), up], dim=-1)
            eyes = targets + radius[:, None] * around
        poses = []
        for second, eye, target in zip(at.tolist(), eyes.tolist(), targets.tolist()):
            try:
                poses.append(look_at(eye, target))
            except ValueError as error:
                raise ValueError(f"keyframes at {second:.3g} seconds: {error}") from error
        times = self._curve("time", at, values)[:, 0].clamp(0, 1).tolist()
        angles: list[float | None] = [None] * len(at)
        if "field_of_view" in self.channels:
            angles = list(torch.deg2rad(self._curve("field_of_view", at, values)[:, 0]).tolist())
        return torch.stack(poses), times, angles

    def _curve(self, name: str, at: Tensor, defaults: Mapping[str, Sequence[float]]) -> Tensor:
        if name not in self.channels:
            return torch.tensor(defaults[name], dtype=at.dtype).expand(len(at), -1)
        given, values = self.channels[name]
        return interpolate(given, values, at, self.interpolation)


def read_key_frames(path: str | Path) -> KeyFrames:
    """Read a key-frame file.

    A file is `{"interpolation": "smooth", "keyframes": [...]}`; a key frame is an object with `seconds` (ascending) and
    any of

    - `time` in [0, 1]: the scene's time;
    - `azimuth`, `elevation` (degrees) and `radius` around `target`, or `eye` ([x, y, z]) instead;
    - `target` ([x, y, z]), the point looked at;
    - `field_of_view` (degrees, horizontal).

    Lengths are in the data set's own units (`in_world`). What a key frame leaves out runs on between those that say it;
    what no key frame says is `DEFAULTS`, or what `sample` is given. Azimuths are not wrapped: 0 to 360 is one turn.

    Raises ValueError naming the file and the entry, for anything else.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a readable JSON file ({error})") from error
    try:
        return parse_key_frames(content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def parse_key_frames(content: Any) -> KeyFrames:
    """Key frames from parsed JSON, see `read_key_frames`; ValueError naming the entry that is wrong."""
    if not isinstance(content, dict) or not isinstance(content.get("keyframes"), list) or not content["keyframes"]:
        raise ValueError('expected an object with a list "keyframes" of at least one, got something else')
    surplus = sorted(content.keys() - {"keyframes", "interpolation"})
    if surplus:
        raise ValueError(f'expected only "keyframes" and "interpolation", got {surplus[0]!r}')
    kind = content.get("interpolation", "smooth")
    check_choice("interpolation", kind, INTERPOLATIONS)
    keys = [_parse_key(f"keyframes[{i}]", entry) for i, entry in enumerate(content["keyframes"])]
    seconds = [key["seconds"][0] for key in keys]
    for i, (before, after) in enumerate(itertools.pairwise(seconds)):
        if not before < after:
            raise ValueError(f"keyframes[{i + 1}].seconds must be more than {before}, got {after}")
    channels = {}
    for name in WIDTHS:
        given = [(key["seconds"][0], key[name]) for key in keys if name in key]
        if given:
            at, values = (torch.tensor(row, dtype=torch.float64) for row in zip(*given))
            channels[name] = at, values
    both = [name for name in AROUND if name in channels]
    if "eye" in channels and both:
        raise ValueError(f"keyframes must place the camera by eye or by {', '.join(AROUND)}, got eye and {both[0]}")
    return KeyFrames((seconds[0], seconds[-1]), channels, kind)


def _parse_key(where: str, entry: Any) -> dict[str, list[float]]:
    if not isinstance(entry, dict):
        raise ValueError(f"{where} must be an object, got {type(entry).__name__}")
    if "seconds" not in entry:
        raise ValueError(f"{where} must have seconds, got {sorted(entry)}")
    surplus = sorted(entry.keys() - WIDTHS.keys() - {"seconds"})
    if surplus:
        raise ValueError(f"{where} must have only seconds, {', '.join(WIDTHS)}; got {surplus[0]!r}")
    key = {name: _numbers(f"{where}.{name}", value, WIDTHS.get(name, 1)) for name, value in entry.items()}
    if "time" in key and not 0 <= key["time"][0] <= 1:
        raise ValueError(f"{where}.time must be in [0, 1], got {key['time'][0]}")
    if "radius" in key:
        check_positive(f"{where}.radius", key["radius"][0])
    for name, low, high in (("elevation", -90, 90), ("field_of_view", 0, 180)):
        if name in key and not low < key[name][0] < high:
            raise ValueError(f"{where}.{name} must be in ({low}, {high}) degrees, got {key[name][0]}")
    return key


def _numbers(where: str, value: Any, count: int) -> list[float]:
    numbers: Sequence[Any] = value if isinstance(value, list) else [value]
    # A JSON true is a Python int, NaN fails the comparison, and an int may be too long for a float.
    finite = [n for n in numbers if isinstance(n, int | float) and not isinstance(n, bool) and abs(n) <= 1e300]
    if isinstance(value, list) != (count > 1) or len(numbers) != count or len(finite) != count:
        expected = "a finite number" if count == 1 else f"{count} finite numbers"
        raise ValueError(f"{where} must be {expected}, got {value!r}")
    return [float(n) for n in finite]
