"""Writing files so that a reader never sees half of one, and folders that one process at a time works in."""

import json
import os
import secrets
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

TEMPORARY = ".tmp-"  # how the names of files in the making begin


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder that becomes `path` when the block ends well, and vanishes otherwise.

    The temporary file keeps the suffix of `path`; it is flushed to the disk before it is renamed, and the folder
    after, so that the new file survives a power cut. A process killed in between leaves the old file as it was, and
    a temporary one that `remove_leftovers` finds.

    Raises:
        OSError: what the block and the system raise; it names `path` where it named no file (a full disk's does not).
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{TEMPORARY}{path.stem}-{secrets.token_hex(8)}{path.suffix}")
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # less the process's umask
    try:
        yield temporary
        _flush(temporary)
        temporary.replace(path)
        _flush(path.parent)
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Have the system write a file, or a folder's entries, to the disk."""
    if path.is_dir() and os.name == "nt":
        return  # folders cannot be opened there
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def replaced_folder(path: Path, is_own: Callable[[str], bool]) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path` when the block ends well, and vanishes otherwise.

    Raises:
        ValueError: if there is something at `path` already, beside a folder that holds only files whose names are its
            own.
    """
    path = Path(os.path.abspath(path))
    if os.path.lexists(path) and not (path.is_dir() and all(is_own(file.name) for file in path.iterdir())):
        raise ValueError(f"path must be a new folder or one of earlier frames, got {path}, which holds other things")
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        unfinished, replaced = Path(folder) / "unfinished", Path(folder) / "replaced"
        unfinished.mkdir()
        yield unfinished
        if path.is_dir():
            path.rename(replaced)
        unfinished.rename(path)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, indented; NaN and infinity are refused with ValueError."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that killed processes left in a folder; nobody may be writing there now."""
    for path in Path(folder).glob(f"{TEMPORARY}*"):
        if path.is_file() and not path.is_symlink():
            path.unlink(missing_ok=True)


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Hold a folder for this process alone while the block lasts; the claim dies with the process, however it ends.

    Where the system or the file system knows no locks, nothing is claimed.

    Raises:
        ValueError: if another process holds the folder.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"{folder} is in use by another process; wait for it or stop it") from None
        except OSError:
            pass
        yield
    finally:
        os.close(handle)
