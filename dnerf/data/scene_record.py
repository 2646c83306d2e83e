"""What a run keeps of its data set, `scene.json`: the world, and the cameras and times of every split.

Films and viewers need nothing else; images are read for scores and comparisons only.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dnerf.core.cameras import Intrinsics
from dnerf.core.checks import as_box, check_shape
from dnerf.core.files import write_json
from dnerf.core.lenses import Distortion
from dnerf.data.frames import is_rigid
from dnerf.data.normalization import IDENTITY, Clock, Similarity, Vector

SCENE = "scene.json"
VERSION = 1
MAX_BYTES = 64 * 2**20

Box = tuple[Vector, Vector]


@dataclass(frozen=True)
class World:
    """Where a data set stands in the world that models live in."""

    box: Box  # corners of what is modelled, in world units
    similarity: Similarity = IDENTITY  # from the data set's own units
    clock: Clock = field(default_factory=Clock)  # from the data set's own times
    # z-depths near and far in world units, where they were given; None follows from the box
    planes: tuple[float | None, float | None] = (None, None)
    has_alpha: bool = False  # whether training images are transparent somewhere
    notes: tuple[str, ...] = ()  # how all this was found, a line each
    warnings: tuple[str, ...] = ()  # what is doubtful, or cannot be determined from these images


@dataclass(frozen=True, eq=False)
class CameraSet:
    """The cameras of a split in world units; ValueError if numbers differ or a pose is not rigid."""

    poses: Tensor  # (F, 4, 4) float32, camera to world
    times: Tensor  # (F,) float32 in [0, 1]
    intrinsics: tuple[Intrinsics, ...]  # F; equal ones are one object
    names: tuple[str, ...] = ()  # F, or none
    have_images: bool = True  # whether the data set has images of them

    def __post_init__(self) -> None:
        check_shape("poses", self.poses, (len(self.intrinsics), 4, 4))
        check_shape("times", self.times, (len(self.intrinsics),))
        if not len(self.intrinsics) or len(self.names) not in (0, len(self.intrinsics)):
            raise ValueError(f"names must be {len(self.intrinsics)} or none, got {len(self.names)}")
        if not bool(is_rigid(self.poses).all()):
            raise ValueError("poses must be rigid")
        if not bool(((self.times >= 0) & (self.times <= 1)).all()):
            raise ValueError("times must be in [0, 1]")

    def __len__(self) -> int:
        return len(self.intrinsics)


@dataclass(frozen=True, eq=False)
class SceneRecord:
    """A data set without its images."""

    world: World
    cameras: Mapping[str, CameraSet]  # by split, "train" among them

    @property
    def times(self) -> tuple[float, float]:
        """First and last time of the training frames."""
        times = self.cameras["train"].times
        return float(times.min()), float(times.max())

    def split(self, name: str | None) -> tuple[str, CameraSet]:
        """The split of a name, or where it is None, test if there is one, else train; ValueError for one not there."""
        if name is None:
            name = "test" if "test" in self.cameras else "train"
        if name not in self.cameras:
            raise ValueError(f"split must be one of {', '.join(self.cameras)}, got {name!r}")
        return name, self.cameras[name]

    def write(self, folder: Path) -> None:
        """Write `scene.json` into a run's folder."""
        write_json(Path(folder) / SCENE, {
            "version": VERSION, "world": asdict(self.world),
            "cameras": {name: _plain(cameras) for name, cameras in self.cameras.items()},
        })  # fmt: skip

    def summary(self) -> list[str]:
        """What there is, a line each: frames of every split, lens, times."""
        lines = []
        for split, cameras in self.cameras.items():
            sizes = sorted({f"{lens.width} x {lens.height}" for lens in cameras.intrinsics})
            shown = sizes[0] if len(sizes) == 1 else f"{len(sizes)} sizes, {sizes[0]} to {sizes[-1]}"
            what = "frames" if cameras.have_images else "cameras without images"
            lines.append(f"{split}: {len(cameras)} {what} of {shown}")
        first, last = self.times
        own = " to ".join(f"{self.world.clock.own(time):.10g}" for time in (first, last))
        times = f"training from {first:.4g} to {last:.4g}, {own} by the data's clock"
        lenses = [lens for cameras in self.cameras.values() for lens in cameras.intrinsics]
        return [*lines, _lens_summary(lenses), f"times: {'one for all frames: static' if first == last else times}"]

    @classmethod
    def read(cls, folder: str | Path) -> "SceneRecord":
        """Read a run's `scene.json`.

        Raises:
            ValueError: naming the file and what is wrong, if it is missing, too large or not what `write` writes.
        """
        path = Path(folder) / SCENE
        try:
            if path.stat().st_size > MAX_BYTES:
                raise ValueError(f"more than {MAX_BYTES // 2**20} MiB")
            value = json.loads(path.read_text(encoding="utf-8"))
            if value["version"] != VERSION:
                raise ValueError(f"version must be {VERSION}, got {value['version']!r}")
            record = cls(_world(value["world"]), {str(k): _camera_set(v) for k, v in value["cameras"].items()})
            if "train" not in record.cameras:
                raise ValueError("cameras must hold those of the train split")
            return record
        except FileNotFoundError:
            raise ValueError(
                f"{path}: file does not exist; training writes it when it begins; runs of earlier versions have "
                "none and must be trained again"
            ) from None
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
            said = " ".join(str(error).split())[:200]
            raise ValueError(f"{path}: not a scene that this version has written ({said})") from error


def _lens_summary(lenses: Sequence[Intrinsics]) -> str:
    first = lenses[0]
    bent = "" if first.distortion is None else f", {first.distortion.model} {first.distortion.radial}"
    others = "" if len(set(lenses)) == 1 else f", one of {len(set(lenses))}"
    focal = f"focal lengths {first.focal_x:.2f} and {first.focal_y:.2f} pixels"
    return f"lens: {focal}, principal point {first.center[0]:.2f}, {first.center[1]:.2f}{bent}{others}"


def _plain(cameras: CameraSet) -> dict[str, Any]:
    unique = list(dict.fromkeys(cameras.intrinsics))
    return {
        "poses": cameras.poses.tolist(), "times": cameras.times.tolist(), "names": list(cameras.names),
        "have_images": cameras.have_images, "intrinsics": [asdict(lens) for lens in unique],
        "intrinsics_indices": [unique.index(lens) for lens in cameras.intrinsics],
    }  # fmt: skip


def _camera_set(value: Mapping[str, Any]) -> CameraSet:
    lenses = [_intrinsics(lens) for lens in value["intrinsics"]]
    indices = value["intrinsics_indices"]
    if not all(type(index) is int and 0 <= index < len(lenses) for index in indices):
        raise ValueError("intrinsics_indices must name intrinsics")
    return CameraSet(
        torch.tensor(value["poses"], dtype=torch.float32), torch.tensor(value["times"], dtype=torch.float32),
        tuple(lenses[index] for index in indices), tuple(map(str, value["names"])), bool(value["have_images"]),
    )  # fmt: skip


def _intrinsics(value: Mapping[str, Any]) -> Intrinsics:
    given = dict(value)
    for name in ("width", "height"):
        if type(given[name]) is not int:
            raise ValueError(f"{name} must be a whole number, got {given[name]!r}")
    bend = given.pop("distortion", None)
    if bend is not None:
        tangential = _numbers("tangential", bend["tangential"], 2)
        bend = Distortion(bend["model"], tuple(_numbers("radial", bend["radial"])), (tangential[0], tangential[1]))
    return Intrinsics(**given, distortion=bend)


def _world(value: Mapping[str, Any]) -> World:
    low, high = (_vector("box", corner) for corner in value["box"])
    as_box((low, high))  # checks it
    turn = value["similarity"]
    first, second, third = (_vector("rotation", row) for row in turn["rotation"])
    similarity = Similarity(
        _numbers("scale", [turn["scale"]])[0], (first, second, third), _vector("center", turn["center"])
    )
    clock = Clock(*_numbers("clock", [value["clock"]["start"], value["clock"]["length"]]))
    near, far = (None if plane is None else _numbers("planes", [plane])[0] for plane in value["planes"])
    notes, warnings = (tuple(map(str, value[name])) for name in ("notes", "warnings"))
    return World((low, high), similarity, clock, (near, far), bool(value["has_alpha"]), notes, warnings)


def _vector(name: str, values: Sequence[Any]) -> Vector:
    x, y, z = _numbers(name, values, 3)
    return x, y, z


def _numbers(name: str, values: Sequence[Any], count: int | None = None) -> list[float]:
    if not isinstance(values, list) or count not in (None, len(values)):
        raise ValueError(f"{name} must be {count} numbers, got {values!r}")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"{name} must be finite numbers, got {value!r}")
    return [float(value) for value in values]
