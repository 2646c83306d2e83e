"""Frames on their way to a film: one file each, written whole or not at all, so that a killed rendering can resume."""

import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dnerf.core.files import atomic_path

Layers = Mapping[str, NDArray]


class FrameStore:
    """A folder of `frame_00000.npz`, ..., made upon the first frame.

    A file holds a frame's layers and appears when it is complete, flushed to the disk: whoever is killed loses the
    frames in hand and nothing else.
    """

    def __init__(self, folder: Path, num_frames: int) -> None:
        self.folder = Path(folder)
        self.num_frames = num_frames

    def path(self, index: int) -> Path:
        """Where a frame's file lies."""
        return self.folder / f"frame_{index:05d}.npz"

    def missing(self) -> list[int]:
        """Indices of the frames that are not there, ascending."""
        return [i for i in range(self.num_frames) if not self.path(i).exists()]

    def write(self, index: int, layers: Layers) -> None:
        """Write a frame's layers."""
        with atomic_path(self.path(index)) as temporary, temporary.open("wb") as file:
            np.savez(file, **layers)  # type: ignore[arg-type]

    def read(self, index: int) -> dict[str, NDArray]:
        """Read a frame's layers; ValueError naming the file, if it is missing or damaged."""
        path = self.path(index)
        try:
            with np.load(path, allow_pickle=False) as file:
                return {name: file[name] for name in file.files}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path}: not a readable frame ({error}); delete it to have it rendered again") from error

    def __iter__(self) -> Iterator[dict[str, NDArray]]:
        """Every frame's layers in order, one in memory at a time."""
        return (self.read(i) for i in range(self.num_frames))

    def remove(self) -> None:
        """Delete the folder, unfinished files of killed processes included."""
        shutil.rmtree(self.folder, ignore_errors=True)


def write_npz(store: FrameStore, path: Path, extra: Layers) -> Path:
    """Stack all frames' layers into one NPZ file, (F, ...) each; memory is that of one frame.

    Further arrays are written as they are. Raises ValueError if a frame is missing or damaged, or frames differ in
    their layers' shapes.
    """
    first = store.read(0)
    with atomic_path(Path(path)) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, value in extra.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)
        for name, layer in first.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                header = np.lib.format.header_data_from_array_1_0(layer)
                header.update(shape=(store.num_frames, *layer.shape), fortran_order=False)
                np.lib.format.write_array_header_1_0(member, header)
                for index, frame in enumerate(store):
                    if name not in frame or (frame[name].shape, frame[name].dtype) != (layer.shape, layer.dtype):
                        raise ValueError(
                            f"{store.path(index)}: {name} must be {layer.dtype} {layer.shape} as in frame 0"
                        )
                    member.write(np.ascontiguousarray(frame[name]).tobytes())
    return Path(path)
