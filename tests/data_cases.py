"""Small data sets with the peculiarities of people's own, and what is right for each.

They show a soft ball that moves. Its colour along any ray is a formula, so that what a data set is understood to be can
be compared with what it was made of, pixel by pixel.
"""

import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import data_folders
import numpy as np
from data_folders import CENTER, FLIP, FOCAL, HEIGHT, NUM_FRAMES, WIDTH, poses, write_json
from PIL import Image

Maker = Callable[[Path], object]
RADIUS, SOFT = 0.8, 0.3
WHITE, BLACK, GREY = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.4, 0.4, 0.4)
NUM_TRAIN = 6
TEST_TIMES = (0.4, 0.6)


def look(origins: np.ndarray, directions: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What rays (P, 3) show at times (P,): straight colour and opacity (P, 4), and where they hit (P, 3)."""
    center = CENTER + 0.25 * np.stack([np.cos(3 * times), np.sin(3 * times), times], -1)
    along = ((center - origins) * directions).sum(-1)
    inside = RADIUS**2 - ((center - origins) ** 2).sum(-1) + along**2
    hit = origins + (along - np.sqrt(inside.clip(0)))[:, None] * directions
    color = 0.5 + 0.4 * np.sin(3 * (hit - center) * [1.0, 1.3, 0.7] + [0, 1, 2])
    return np.concatenate([color, (inside / SOFT).clip(0, 1)[:, None]], -1), hit


@dataclass(frozen=True)
class Lens:
    """A camera's intrinsics, and its rays by its formula."""

    width: int = 24
    height: int = 24
    fx: float = 33.0
    fy: float = 33.0
    cx: float = 12.0
    cy: float = 12.0
    k1: float = 0.0
    fisheye: bool = False

    def directions(self) -> np.ndarray:
        """(P, 3) unit directions of all pixels in the camera's space, OpenGL's axes."""
        x, y = (np.arange(self.width) + 0.5 - self.cx) / self.fx, (np.arange(self.height) + 0.5 - self.cy) / self.fy
        x, y = (values.ravel() for values in np.meshgrid(x, y))
        bent = np.hypot(x, y)
        straight = bent
        for _ in range(60):  # straight (1 + k1 straight^2) = bent, a contraction
            straight = bent / (1 + self.k1 * straight**2)
        share = (np.tan(straight) if self.fisheye else straight) / np.maximum(bent, 1e-9)
        local = np.stack([x * share, -y * share, -np.ones_like(x)], -1)
        return local / np.linalg.norm(local, axis=-1, keepdims=True)

    def image(self, pose: np.ndarray, time: float) -> np.ndarray:
        """(H, W, 4) uint8 of straight alpha."""
        directions = self.directions() @ pose[:3, :3].T
        rgba, _ = look(pose[:3, 3][None], directions, np.full(len(directions), time))
        return np.rint(255 * rgba).astype(np.uint8).reshape(self.height, self.width, 4)

    def stated(self) -> dict[str, Any]:
        """As nerfstudio's files say it."""
        return {"fl_x": self.fx, "fl_y": self.fy, "cx": self.cx, "cy": self.cy, "w": self.width, "h": self.height}


# How images are saved: `save(stem, pixels)` writes pixels (H, W, 4) of straight alpha.


def png(stem: Path, pixels: np.ndarray) -> None:
    Image.fromarray(pixels).save(f"{stem}.png")


def before(color: tuple[float, ...], suffix: str = ".png", orientation: int = 1) -> Callable[[Path, np.ndarray], None]:
    """Opaque images before one colour; of orientation 6, stored lying on their side."""

    def save(stem: Path, pixels: np.ndarray) -> None:
        alpha = pixels[..., 3:] / 255
        opaque = np.rint(pixels[..., :3] * alpha + 255 * (1 - alpha) * color).astype(np.uint8)
        exif = Image.Exif()
        exif[0x0112] = orientation
        stored = np.ascontiguousarray(np.rot90(opaque)) if orientation == 6 else opaque
        Image.fromarray(stored).save(f"{stem}{suffix}", quality=98, subsampling=0, exif=exif)

    return save


def black_for_test(stem: Path, pixels: np.ndarray) -> None:
    (before(BLACK) if stem.parent.name == "test" else png)(stem, pixels)


def sixteen_bits(stem: Path, pixels: np.ndarray) -> None:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + row.tobytes() for row in (pixels.astype(np.uint32) * 257 + 7).clip(0, 65535).astype(">u2"))
    header = struct.pack(">IIBBBBB", width, height, 16, 6, 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    Path(f"{stem}.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)


def grey_or_palette(stem: Path, pixels: np.ndarray) -> None:
    image = Image.fromarray(pixels).convert("LA")
    if int(stem.name[-1]) % 2:
        image = image.convert("RGBA").quantize(256, method=Image.Quantize.FASTOCTREE)
    image.save(f"{stem}.png")


def beside_masks(stem: Path, pixels: np.ndarray) -> None:
    """Opaque, with clutter where nothing is; the mask lies in another folder."""
    clutter = np.random.default_rng(0).integers(0, 256, pixels[..., :3].shape, dtype=np.uint8)
    alpha = pixels[..., 3:]
    masks = stem.parent.parent / "masks"
    masks.mkdir(exist_ok=True)
    Image.fromarray(np.where(alpha > 0, pixels[..., :3], clutter)).save(f"{stem}.png")
    Image.fromarray(alpha[..., 0]).save(masks / f"{stem.parent.name}_{stem.name}.png")


def mask_path(split: str, index: int, _: Lens) -> dict[str, Any]:
    return {"mask_path": f"masks/{split}_r_{index:03d}.png"}


# Folders.

PLAIN = Lens()


def blender(
    top: dict[str, Any] | None = None, each: Callable[[str, int, Lens], dict[str, Any]] = lambda *_: {}, *,
    lens: Callable[[int], Lens] = lambda _: PLAIN, save: Callable[[Path, np.ndarray], None] = png,
    place: Callable[[np.ndarray], np.ndarray] = lambda pose: pose, moment: float | None = None,
    times: tuple[float, ...] = tuple(i / (NUM_TRAIN - 1) for i in range(NUM_TRAIN)),
    test_times: tuple[float, ...] = TEST_TIMES, still: bool = False,
) -> Maker:  # fmt: skip
    """A maker of a folder in D-NeRF's format.

    Args:
        top: the files' own fields; the field of view if None.
        each: further fields of each frame of a split; `...` removes one.
        place: from a pose to what is written.
        moment: when all images are taken, whatever times are written.
        still: whether training images are of one pose.
    """
    fields = {"camera_angle_x": 2 * math.atan(0.5 * PLAIN.width / PLAIN.fx)} if top is None else top

    def make(root: Path) -> None:
        around = poses(len(times) + len(test_times))
        for split, first, own in (("train", 0, times), ("test", len(times), test_times)):
            (root / split).mkdir(parents=True)
            frames = []
            for index, time in enumerate(own):
                pose, camera = around[0 if still and split == "train" else first + index], lens(index)
                save(root / f"{split}/r_{index:03d}", camera.image(pose, time if moment is None else moment))
                entry = {"file_path": f"./{split}/r_{index:03d}", "time": time}
                entry |= {"transform_matrix": place(pose).tolist(), **each(split, index, camera)}
                frames.append({key: value for key, value in entry.items() if value is not ...})
            write_json(root / f"transforms_{split}.json", {**fields, "frames": frames})

    return make


def moved(scale: float = 1.0, shift: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Maker:
    def place(pose: np.ndarray) -> np.ndarray:
        placed = pose.copy()
        placed[:3, 3] = scale * pose[:3, 3] + shift
        return placed

    return blender(place=place)


def without(*names: str) -> Maker:
    """The plain folder without these files."""

    def made(root: Path) -> None:
        blender()(root)
        for path in [path for name in names for path in root.glob(name)]:
            path.unlink()

    return made


def repainted(write: Maker, images: str, count: int = 1, lens: Lens | None = None, suffix: str = "") -> Maker:
    """A folder of `data_folders`, its images showing the ball; `count` moments of every camera."""
    camera = lens or Lens(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)

    def make(root: Path) -> None:
        write(root)
        moments = NUM_FRAMES if count == 1 else count
        for index in range(NUM_FRAMES * count):
            view, moment = (index, index) if count == 1 else divmod(index, count)
            path = root / images.format(view, moment)
            path.parent.mkdir(parents=True, exist_ok=True)
            pixels = camera.image(poses()[view], moment / (moments - 1))
            before(WHITE, suffix or path.suffix)(path.with_suffix(""), pixels)

    return make


def write_nerfstudio(root: Path) -> None:
    """As `ns-process-data` writes it, with a lens that bends."""
    frames = [
        {**frame, "file_path": f"images/frame_{index:05d}.jpg", "colmap_im_id": index}
        for index, frame in enumerate(data_folders.listed("images"))
    ]
    bent = {"camera_model": "OPENCV", "k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    done = {"applied_transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "ply_file_path": "sparse_pc.ply"}
    write_json(root / "transforms.json", {**data_folders.lens(), **bent, **done, "frames": frames})


def write_colmap(root: Path) -> None:
    """With sparse points all around the ball."""
    data_folders.write_colmap(root, binary=False)
    points = CENTER + RADIUS * np.random.default_rng(0).uniform(-1.3, 1.3, (50, 3))
    rows = [f"{i} {x} {y} {z} 255 0 0 0.5 1 0" for i, (x, y, z) in enumerate(points)]
    (root / "sparse/0/points3D.txt").write_text("\n".join(rows))


def write_rows(root: Path) -> None:
    root.mkdir()
    np.save(root / "poses_bounds.npy", data_folders.llff_rows())


@dataclass(frozen=True)
class Case:
    """A data set, and what is right for it."""

    make: Maker
    settings: dict[str, Any] = field(default_factory=dict)  # with which it is right
    refused: str = ""  # what is said without them; or at all, where `count` is 0
    said: str = ""  # in a note or warning
    scale: float = 1.0  # of its units
    shift: tuple[float, ...] = (0.0, 0.0, 0.0)  # of its origin, in its units
    moment: float | None = None  # of all frames, where nothing moves
    behind: tuple[float, ...] | None = None  # the colour behind opaque images
    behind_test: tuple[float, ...] | None = None
    levels: float = 2.0  # of 255, by which pixels may differ: colour and alpha are rounded, and their product
    grey: bool = False
    count: tuple[int, int] = (NUM_TRAIN, len(TEST_TIMES))  # of training and test frames


AWAY = Lens(22, 20, 33.0, 33.0, 9.0, 8.0)
OBLONG = Lens(23, 17, 30.0, 24.0, 11.5, 8.5)
UPRIGHT = Lens(18, 24, 33.0, 33.0, 8.0, 13.0)
EYES = [Lens(fx=f * 22, fy=f * 22, k1=0.12, fisheye=True) for f in (1.0, 1.2)]
BENT = Lens(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, k1=0.1)
JPEG = 12.0  # levels: what JPEG leaves of a soft ball's colours
FISHEYE = {"camera_model": "OPENCV_FISHEYE", "is_fisheye": True, "k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0}


def by_matrix(_: str, __: int, lens: Lens) -> dict[str, Any]:
    return {"K": [[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]]}


def angles(lens: Lens) -> dict[str, Any]:
    sides = {"x": lens.width / lens.fx, "y": lens.height / lens.fy}
    return {f"camera_angle_{axis}": 2 * math.atan(0.5 * side) for axis, side in sides.items()}


CASES = {
    "00-plain": Case(blender()),
    "01-intrinsics-in-every-frame": Case(blender({}, lambda _, __, lens: lens.stated())),
    "03-units-x50": Case(moved(50), scale=50),
    "04-off-centre": Case(moved(shift=(12, -7, 3)), shift=(12, -7, 3)),
    "06-opencv-axes": Case(
        blender(place=lambda pose: pose @ FLIP), {"axes": "opencv"}, "look away from .*; set data.axes=opencv if"
    ),
    "07-no-time": Case(blender(each=lambda *_: {"time": ...}, moment=0.0), said="data.times=order", moment=0.0),
    "07-no-time, in order": Case(
        blender(each=lambda *_: {"time": ...}, test_times=(0.0, 1.0)), {"times": "order"}, said="order of the frames"
    ),
    "08-frame-numbers-as-time": Case(
        blender(each=lambda split, i, _: {"time": i if split == "train" else i + 2}), said="times 0 to 5 of the files"
    ),
    "10-nerfstudio-single-file": Case(
        repainted(write_nerfstudio, "images/frame_{0:05d}.jpg", lens=BENT), {"hold_out": 3}, said="held out",
        behind=WHITE, levels=JPEG, count=(3, 1),
    ),
    "11-windows-paths": Case(
        blender(each=lambda s, i, _: {"file_path": f".\\..\\scene\\{s}/r_{i:03d}.png"}), said="backslashes"
    ),
    "13-train-only": Case(without("transforms_test.json", "test/*"), said="held out", count=(NUM_TRAIN - 1, 1)),
    "14-test-without-pictures": Case(without("test/*"), said="only cameras are read", count=(NUM_TRAIN, 0)),
    "15-opaque-white-jpeg": Case(blender(save=before(WHITE, ".jpg")), behind=WHITE, levels=JPEG),
    "17-background-said-in-file": Case(
        blender({**angles(PLAIN), "background": GREY}, save=before(GREY)), behind=GREY
    ),
    "18-test-opaque-black": Case(blender(save=black_for_test), behind_test=BLACK),
    "19-16-bit": Case(blender(save=sixteen_bits)),
    "20-palette-and-grey": Case(blender(save=grey_or_palette), levels=30.0, grey=True),
    "21-exif-portrait": Case(
        blender(UPRIGHT.stated(), lens=lambda _: UPRIGHT, save=before(WHITE, ".jpg", 6)), behind=WHITE, levels=JPEG
    ),
    "23-odd-size-angle-y": Case(blender(angles(OBLONG), lens=lambda _: OBLONG)),
    "24-off-centre-principal-point": Case(blender({**AWAY.stated(), "w": 22.0, "h": 20.0}, lens=lambda _: AWAY)),
    "25-intrinsics-of-full-size": Case(
        blender({key: 4 * value for key, value in PLAIN.stated().items()}), said="intrinsics of 96 x 96 are scaled"
    ),
    "26-one-frame": Case(
        blender(times=(0.0,), moment=0.0), said="there is one training image", moment=0.0, count=(1, 2)
    ),
    "28-all-same-time": Case(
        blender(each=lambda *_: {"time": 0.0}, moment=0.0), said="all frames have one time", moment=0.0
    ),
    "29-static-camera": Case(blender(still=True), said="one camera that stands still"),
    "34-fisheye-and-masks": Case(
        blender(
            FISHEYE, lambda s, i, lens: {**lens.stated(), "k1": 0.12, **mask_path(s, i, lens)},
            lens=lambda index: EYES[index % 2], save=beside_masks,
        ),
    ),
    "35-missing-pictures": Case(
        without("train/r_003.png"), refused=r"r_003: image does not exist.* add them, or take their frames out",
        count=(0, 0),
    ),
    "38-mask-files": Case(blender(each=mask_path, save=beside_masks)),
    "39-nerfies-capture": Case(
        repainted(data_folders.write_nerfies, "rgb/2x/{0:06d}.png"), {"hold_out": 3}, behind=WHITE, count=(3, 1)
    ),
    "40-colmap-text": Case(
        repainted(write_colmap, "images/{0:04d}.png"),
        {"hold_out": 3}, said="times are the numbers in images' names", behind=WHITE, count=(3, 1),
    ),
    "41-llff-rig": Case(
        repainted(write_rows, "cam{0:02d}/{1:04d}.png", 3), behind=WHITE, said="held out", count=(11, 1)
    ),
    "42-near-cameras": Case(moved(0.4), scale=0.4),
    "44-clustered-times": Case(blender(times=(0.0, 0.02, 0.05, 0.1, 0.95, 1.0))),
    "46-data-gone": Case(blender()),
    "48-matrix-k-in-every-frame": Case(
        blender(PLAIN.stated(), by_matrix, lens=lambda i: Lens(fx=33 * (1 + i % 3 / 2), fy=33 * (1 + i % 3 / 2)))
    ),
}  # fmt: skip
