"""The decisions about a scene: a table that a person can read, save and override."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from dnerf.core.files import write_text
from dnerf.data.frames import Frames
from dnerf.planning.parts import Part

FILE = "plan.yaml"
AS_SET = "as set"  # why a given choice stands, unless something speaks against it
MAX_BYTES = 64 * 1024


@dataclass(frozen=True)
class Decision:
    """What was decided about one part."""

    choice: str  # name of the candidate
    by: str  # "given" by the user, found in "images", in a "trial", or the "default" where nothing decided
    why: str  # in a few words
    gain: float | None = None  # over the next best candidate on held-out pixels, in dB; None without a trial
    error: float | None = None  # standard error of that, in dB
    seconds: float = 0.0  # that the decision took, winner's steps left out


@dataclass(frozen=True)
class Plan:
    """Decisions by the names of parts, about one data set."""

    decisions: Mapping[str, Decision]
    data: str = ""  # `fingerprint` of the training frames; empty for any

    @property
    def choices(self) -> dict[str, str]:
        """Names of the chosen candidates, by part."""
        return {name: decision.choice for name, decision in self.decisions.items()}

    def rows(self) -> list[tuple[str, ...]]:
        """The decisions as a table of texts, its header first."""
        rows: list[tuple[str, ...]] = [("part", "choice", "by", "gain (dB)", "seconds", "why")]
        for name, d in self.decisions.items():
            gain = "" if d.gain is None else f"{d.gain:+.2f} ± {d.error or 0:.2f}"
            rows.append((name, d.choice, d.by, gain, f"{d.seconds:.1f}", d.why))
        return rows

    def table(self) -> str:
        """The decisions, a line each."""
        rows = self.rows()
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]) - 1)]
        padded = ([*(cell.ljust(w) for cell, w in zip(row, widths)), row[-1]] for row in rows)
        return "\n".join("  ".join(cells).rstrip() for cells in padded)

    def save(self, path: Path) -> None:
        """Write it as YAML, to be read, changed and used again (`plan.file`)."""
        parts = {name: {k: v for k, v in asdict(d).items() if v is not None} for name, d in self.decisions.items()}
        text = yaml.safe_dump({"data": self.data, "parts": parts}, sort_keys=False, allow_unicode=True, width=110)
        write_text(path, text)


def fingerprint(frames: Frames) -> str:
    """Sixteen hexadecimal digits of a data set's poses and times."""
    digest = hashlib.sha256(frames.poses.cpu().numpy().tobytes())
    digest.update(frames.times.cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


def load_plan(path: Path) -> Plan:
    """A saved plan; ValueError, naming file and part, if there is none or it is not such a file."""
    try:
        data = Path(path).read_bytes()
        if len(data) > MAX_BYTES:
            raise ValueError(f"more than {MAX_BYTES} bytes")
        content = yaml.safe_load(data.decode())
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"plan.file: {path} is not a readable plan ({' '.join(str(error).split())[:200]})") from error
    parts = content.get("parts") if isinstance(content, dict) else None
    if not isinstance(parts, dict) or not isinstance(content.get("data", ""), str):
        raise ValueError(f"plan.file: {path} must hold parts by name and the data's fingerprint")
    decisions = {str(name): _decision(f"plan.file: {path}: {name}", value) for name, value in parts.items()}
    return Plan(decisions, content.get("data", ""))


def settled(parts: Mapping[str, Part], given: Mapping[str, object], file: Path | None, data: str) -> dict[str, str]:
    """Candidates that stand already, by part: those given, else those of a saved plan.

    Raises:
        ValueError: for a part or a candidate that there is not, or a plan about other data than those of a fingerprint.
    """
    if file is not None:
        saved = load_plan(file)
        if saved.data and saved.data != data:
            raise ValueError(f"plan.file: {file} is about another data set; leave it out, or the line data in it")
        for name in saved.choices.keys() - parts.keys():
            raise ValueError(f"plan.file: {file}: {name} is none of the parts {', '.join(parts)}")
        given = {**saved.choices, **given}
    for name in given.keys() - parts.keys():
        raise ValueError(f"plan.{name} is none of the parts {', '.join(parts)}")
    return {name: parts[name].named(name, value) for name, value in given.items()}


def _decision(where: str, value: Any) -> Decision:
    known = {field.name for field in fields(Decision)}
    if isinstance(value, str | bool):
        return Decision(value if isinstance(value, str) else str(value).lower(), "given", "by hand")
    if not isinstance(value, dict) or "choice" not in value or value.keys() - known:
        raise ValueError(f"{where} must be a candidate's name, or have choice and some of {', '.join(sorted(known))}")
    numbers = {key: value[key] for key in ("gain", "error", "seconds") if value.get(key) is not None}
    if not all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers.values()):
        raise ValueError(f"{where}: gain, error and seconds must be numbers, got {numbers}")
    return Decision(str(value["choice"]), str(value.get("by", "given")), str(value.get("why", "")), **numbers)
