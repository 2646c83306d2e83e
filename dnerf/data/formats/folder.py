"""Files that a data set names, found inside its folder and nowhere else, and the frame numbers in their names."""

import os
import re
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Any

from dnerf.data.formats.json_files import Notes, short, text

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
OTHER_SUFFIXES = (".webp", ".gif", ".tif", ".tiff", ".bmp", ".exr", ".heic", ".avif")  # of images not read
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".webm", ".avi", ".MP4", ".MOV", ".AVI")
REDUCED = ("images_2", "images_4", "images_8")  # what COLMAP's and nerfstudio's tools write beside images/
MAX_PARTS = 64
MAX_NAME_BYTES = 255  # what file systems allow
MAX_DIGITS = 15  # more are exact in no float64


class Folder:
    """A data set's folder.

    Args:
        root: the folder; ValueError unless it is one.
        notes: collects the repairs.
    """

    def __init__(self, root: Path, notes: Notes) -> None:
        if not root.is_dir():
            raise ValueError(f"root must be a data set's folder, got {root}")
        self.root, self.notes = root, notes
        self._real_root = os.path.realpath(root)

    def image(self, name: Any, where: str) -> tuple[Path, bool]:
        """Where an image lies, or would lie, and whether it is there; `name` may lack its suffix.

        Backslashes, other roots and other suffixes are repaired with a note.

        Raises:
            ValueError: if the name is no text, or leads out of the folder.
        """
        value = text(name, where)
        parts, outside = self._parts(value)
        if any(len(os.fsencode(part)) > MAX_NAME_BYTES for part in parts):
            raise ValueError(f"{where} must have names of at most {MAX_NAME_BYTES} bytes, got {short(value)}")
        for start in range(len(parts)) if outside else (0,):
            path = self._existing("/".join(parts[start:]), where)
            if path is not None:
                if outside:
                    self.notes.add(f"{self.root}: a path that leads out of the folder was read below it, as {where}")
                return path, True
        if not outside and parts:
            return self.root.joinpath(*parts), False
        # A missing image is expected where the folder that should hold it is.
        for start in range(len(parts) - 1):
            if self.root.joinpath(*parts[start:-1]).is_dir():
                return self.root.joinpath(*parts[start:]), False
        raise ValueError(
            f"{where} must stay inside the data set's folder, got {short(value)}; write it relative to {self.root}"
        )

    def inside(self, path: Path, where: str) -> Path:
        """The same path, if no link leads out of the folder; ValueError otherwise."""
        if os.path.commonpath([os.path.realpath(path), self._real_root]) != self._real_root:
            raise ValueError(
                f"{where} must stay inside the data set's folder, got a link out of it: {short(str(path))}; "
                "put the files themselves there"
            )
        return path

    def listed(self, folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
        """Files of these suffixes in a folder, by name; none where it is not there."""
        if not folder.is_dir():
            return []
        paths = sorted(path for path in folder.iterdir() if is_seen(path, suffixes))
        return [self.inside(path, str(folder)) for path in paths if path.is_file()]

    def other_kind(self, path: Path) -> Path | None:
        """A file of a missing image's name with another suffix, if there is one beside it."""
        base = path.with_suffix("") if path.suffix in IMAGE_SUFFIXES else path
        suffixes = (*OTHER_SUFFIXES, *(suffix.upper() for suffix in OTHER_SUFFIXES))
        return next((found for suffix in suffixes if (found := Path(f"{base}{suffix}")).is_file()), None)

    def name(self, path: Path) -> str:
        """A file's name for messages: relative to the folder, without its suffix."""
        relative = path.relative_to(self.root).as_posix()
        return relative.removesuffix(path.suffix) if path.suffix in IMAGE_SUFFIXES else relative

    def times(self, names: Sequence[str]) -> Sequence[float | None]:
        """The numbers in images' names, with a note; None for all where those tell nothing."""
        times = frame_numbers(names)
        if times is None:
            return [None] * len(names)
        self.notes.add(f"{self.root}: times are the numbers in images' names; data.times=static if nothing moves")
        return times

    def _parts(self, value: str) -> tuple[list[str], bool]:
        """The parts of a path's text, and whether it does not start at the folder."""
        drive = PureWindowsPath(value).drive
        if "\\" in value:
            self.notes.add(f"{self.root}: backslashes in file_path were read as slashes")
            value = value.replace("\\", "/")
        outside = value.startswith("/") or bool(drive)
        parts = [part for part in value[len(drive) :].split("/") if part not in ("", ".")][:MAX_PARTS]
        kept: list[str] = []
        for part in parts:
            if part != "..":
                kept.append(part)
            elif kept:
                kept.pop()
            else:
                outside = True
        return kept, outside

    def _existing(self, name: str, where: str) -> Path | None:
        """The image file of that name, with or without suffix, or its reduced copy, really inside the folder."""
        if not name:
            return None
        suffix = next((s for s in IMAGE_SUFFIXES if name.endswith(s)), "")
        stem = name.removesuffix(suffix)
        for candidate in [name, *(name + s for s in IMAGE_SUFFIXES)]:
            if os.path.isfile(self.root / candidate):
                return self.inside(self.root / candidate, where)
        for other in IMAGE_SUFFIXES if suffix else ():
            if os.path.isfile(self.root / (stem + other)):
                self.notes.add(f"{self.root}: images named as {suffix} were read as {other}")
                return self.inside(self.root / (stem + other), where)
        first, _, rest = name.partition("/")
        for reduced in REDUCED if first == "images" and rest else ():
            if (self.root / reduced).is_dir():
                path = self._existing(f"{reduced}/{rest}", where)
                if path is not None:
                    self.notes.add(f"{self.root}: images that are not in images/ were read from {reduced}/")
                    return path
        return None


def is_seen(path: Path, suffixes: tuple[str, ...]) -> bool:
    """Whether a file's name has one of the suffixes, and is not hidden: those are of programs."""
    return path.name.endswith(suffixes) and not path.name.startswith(".")


def frame_numbers(names: Sequence[str]) -> list[float] | None:
    """The last number of each name that is not the same in all; None if a name has none, or the numbers tell nothing.

    Names are those of files without suffix; of folders in them only the last part counts.
    """
    found = [re.findall(r"[0-9]+", name.rpartition("/")[2]) for name in names]
    if not found or not all(found) or any(len(digits) > MAX_DIGITS for group in found for digits in group):
        return None
    fewest = min(len(group) for group in found)
    for place in range(1, fewest + 1):
        values = [float(group[-place]) for group in found]
        if len(set(values)) > 1:
            return values
    return None
