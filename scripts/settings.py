"""What the scripts' own settings may be: another kind of value is refused, in one line, before anything is loaded.

What classes are built from (data, model, trainer) they check themselves.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

from omegaconf import DictConfig, OmegaConf

from dnerf.data import SPLITS

MISSING = object()


@dataclass(frozen=True)
class Kind:
    """Values that a setting may have, and how to say so."""

    words: str
    fits: Callable[[Any], bool]

    def or_null(self) -> "Kind":
        """The same, or null."""
        return Kind(f"{self.words} or null", lambda value: value is None or self.fits(value))


def _whole(least: int) -> Kind:
    def fits(value: object) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and least <= value < 2**63

    return Kind(f"a whole number of at least {least}", fits)


def _listed(kind: Kind, words: str, count: int | None = None) -> Kind:
    def fits(value: object) -> bool:
        if not isinstance(value, Sequence) or isinstance(value, str):
            return False
        return len(value) == (len(value) if count is None else count) and all(kind.fits(item) for item in value)

    return Kind(words, fits)


def _one_of(*choices: str) -> Kind:
    return Kind(f"one of {', '.join(choices)}", lambda value: isinstance(value, str) and value in choices)


def _either(words: str, *kinds: Kind) -> Kind:
    return Kind(words, lambda value: any(kind.fits(value) for kind in kinds))


TRUTH = Kind("true or false", lambda value: isinstance(value, bool))
TEXT = Kind("a text", lambda value: isinstance(value, str))
NUMBER = Kind("a number", lambda value: isinstance(value, Real) and not isinstance(value, bool))
POSITIVE, COUNT = _whole(1), _whole(0)
TEXTS = _listed(TEXT, "a list of texts")
SPLIT = _one_of(*SPLITS).or_null()
PLACE = _listed(NUMBER, "three numbers", 3)
SEVERAL = _either("a text or a list of them", TEXT, Kind("", lambda value: TEXTS.fits(value) and len(value) > 0))

EVERYWHERE: Mapping[str, Kind] = {
    "run": TEXT, "device": TEXT, "data_root": TEXT.or_null(), "output": TEXT.or_null(), "seed": COUNT,
    "num_frames": POSITIVE, "fps": NUMBER,
}  # fmt: skip
KINDS: Mapping[str, Mapping[str, Kind]] = {
    "train": {
        "out_dir": TEXT.or_null(), "resume": TRUTH, "evaluate_split": SPLIT, "evaluate_frames": POSITIVE.or_null(),
        "chunk": POSITIVE,
    },
    "evaluate": {
        "run": TEXT.or_null(), "runs": TEXTS, "protocol": TEXT.or_null(), "split": SPLIT, "label": TEXT.or_null(),
        "lego_split": _one_of("test", "val").or_null(), "table": TEXT.or_null(), "max_frames": POSITIVE.or_null(),
        "worst": COUNT, "kinds": TRUTH, "plots": TRUTH, "consistency": TRUTH, "lpips.enabled": TRUTH,
        "lpips.download": TRUTH, "temporal.enabled": TRUTH, "temporal.num_frames": _whole(3),
        "temporal.resolution": POSITIVE, "chunk": POSITIVE.or_null(),
    },
    "render": {
        "format": SEVERAL, "outputs": SEVERAL, "keep_frames": TRUTH, "chunk": POSITIVE.or_null(),
        "resolution": _either(
            "a width or [width,height] in pixels, or null", POSITIVE.or_null(), _listed(POSITIVE, "", 2)
        ),
        "time": _either("sweep, pingpong, a number or null", TEXT, NUMBER.or_null()),
        "time_range": _listed(NUMBER, "two times", 2).or_null(), "clock": _one_of("run", "data"),
        "subdivision": POSITIVE.or_null(), "surface": TRUTH,
        "path.split": SPLIT, "path.frame": COUNT.or_null(), "path.radius": NUMBER.or_null(),
        "path.elevation": NUMBER.or_null(), "path.azimuth": NUMBER.or_null(), "path.turns": NUMBER.or_null(),
        "path.start_angle": NUMBER.or_null(), "path.target": PLACE.or_null(),
        "path.elevations": _listed(NUMBER, "two angles", 2).or_null(), "path.file": TEXT,
    },
    "tracks": {
        "split": SPLIT, "frame": COUNT, "start": NUMBER.or_null(), "spacing": POSITIVE, "every": POSITIVE,
        "trail": COUNT, "format": TEXT, "resolution": POSITIVE.or_null(), "chunk": POSITIVE.or_null(),
    },
    "mesh": {
        "format": SEVERAL, "time": NUMBER.or_null(), "resolution": POSITIVE, "level": NUMBER.or_null(),
        "min_share": NUMBER, "close_gaps": NUMBER, "key_every": POSITIVE, "interpolation": TEXT, "lit": TRUTH,
    },
    "make_dataset": {
        "out": TEXT, "film": TEXT.or_null(), "num_val": POSITIVE, "num_test": POSITIVE, "resolution": POSITIVE,
        "cameras": POSITIVE.or_null(),
    },
    "capture": {
        "video": TEXT.or_null(), "images": TEXT.or_null(), "model": TEXT.or_null(), "masks": TEXT.or_null(),
        "out_dir": TEXT, "width": POSITIVE, "min_share": NUMBER,
    },
    "report": {"title": TEXT.or_null(), "films": TEXTS.or_null()},
}  # fmt: skip


def check_settings(config: DictConfig, script: str) -> None:
    """Refuse settings of a script that are of another kind than it works with.

    Args:
        config: composed, before anything is built from it.
        script: name of the script's config.

    Raises:
        ValueError: naming the setting, what was expected and what came.
    """
    for name, kind in {**EVERYWHERE, **KINDS.get(script, {})}.items():
        value = OmegaConf.select(config, name, default=MISSING)
        if value is not MISSING and not kind.fits(value):
            raise ValueError(f"{name} must be {kind.words}, got {value!r}")
