"""Writing a data set: D-NeRF's format, and nerfstudio's."""

import json
import math
import os
import re
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from PIL import Image

from dnerf.core.backgrounds import parse_color
from dnerf.data.frames import Frames
from dnerf.data.images import straight_alpha

MAX_THREADS = 4


def save_blender(frames_by_split: Mapping[str, Frames], root: str | Path) -> None:
    """Write the frames of each split as a data set that `load_blender` and the field's other codebases read.

    Images become PNG with straight alpha (`load_blender` restores the premultiplied pixels exactly), or RGB if they
    have none (D-NeRF's own loader expects alpha). Beyond D-NeRF's fields, files state `fl_x, fl_y, cx, cy, w, h, near,
    far` and, where not the default, `pixel_origin` and `background`. D-NeRF's code wants the splits train, val and
    test, and a first time of 0 in train.

    Everything is written to a temporary folder beside `root` that is renamed at the end: there is no half a data set.

    Raises:
        ValueError: if there are no splits, a name is not plain, colours exceed their alpha (not premultiplied), or
            `root` holds something.
    """
    root = Path(os.path.realpath(root))
    if not frames_by_split:
        raise ValueError("frames_by_split must hold at least one split, got none")
    for split, frames in frames_by_split.items():
        _check_split(split)
        if frames.shared_intrinsics is None or frames.shared_intrinsics.distortion is not None:
            raise ValueError(f"frames_by_split[{split!r}] must share one pinhole, got other intrinsics")
        for index in range(len(frames) if frames.has_alpha else 0):
            image = frames.stored_image(index)
            # One level above is what rounding of equal floats can leave; it is clamped.
            if bool((image[..., :3].short() > image[..., 3:].short() + 1).any()):
                raise ValueError(
                    f"frames_by_split[{split!r}] must be premultiplied, got colours above their alpha in frame {index}"
                )
    if os.path.lexists(root) and not (root.is_dir() and not any(root.iterdir())):
        raise ValueError(f"root must be a new or empty folder, got {root}")
    root.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{root.name}.", dir=root.parent) as temporary:
        # A folder inside the temporary one has the usual permissions; the temporary one itself is private.
        folder = Path(temporary) / root.name
        for split, frames in frames_by_split.items():
            _write_split(frames, split, folder)
        if root.is_dir():
            root.rmdir()
        folder.rename(root)


def _write_split(frames: Frames, split: str, folder: Path) -> None:
    (folder / split).mkdir(parents=True)
    names = [f"./{split}/r_{index:03d}" for index in range(len(frames))]

    def write(index: int) -> None:
        pixels = frames.stored_image(index).cpu().numpy()
        image = Image.fromarray(straight_alpha(pixels) if frames.has_alpha else pixels)
        image.save(folder / f"{names[index]}.png")

    _in_threads(write, len(frames), MAX_THREADS)
    camera = frames.intrinsics[0]
    fields: dict[str, Any] = {
        "camera_angle_x": 2 * math.atan(0.5 * camera.width / camera.focal_x), "fl_x": camera.focal_x,
        "fl_y": camera.focal_y, "cx": camera.center_x, "cy": camera.center_y, "w": camera.width, "h": camera.height,
        "near": frames.near, "far": frames.far,
        "pixel_origin": None if camera.pixel_origin == "center" else camera.pixel_origin,
        "background": None if frames.background is None else parse_color(frames.background),
    }  # fmt: skip
    fields = {name: value for name, value in fields.items() if value is not None}
    fields["frames"] = [
        {"file_path": name, "time": time, "transform_matrix": pose}
        for name, time, pose in zip(names, frames.times.tolist(), frames.poses.tolist())
    ]
    (folder / f"transforms_{split}.json").write_text(json.dumps(fields, indent=1, allow_nan=False))


def _check_split(split: str) -> None:
    if not re.fullmatch(r"\w[\w.-]*", split):
        raise ValueError(f"split must be a plain name such as train, got {split!r}")


def _in_threads(work: Callable[[int], None], number: int, num_threads: int) -> None:
    """Call `work(0..number-1)` in threads; the first failure in that order is raised, the rest cancelled."""
    with ThreadPoolExecutor(num_threads) as pool:
        futures = [pool.submit(work, index) for index in range(number)]
        try:
            for future in futures:
                future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
