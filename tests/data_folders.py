"""The same small scene in the files of every format, written here by hand, not by the code under test; and frames as
files have them, neither placed in the world nor timed anew.

Four cameras of 8 x 6 pixels look at a point from around it, at times 0 to 3.
"""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from dnerf.data import Frames
from dnerf.data.formats import read_capture
from dnerf.data.loading import load_frames

WIDTH, HEIGHT, FOCAL = 8, 6, 9.5
NUM_FRAMES = 4
PLANES = (1.5, 7.0)
CENTER = np.array([0.3, -0.2, 0.1])
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # between OpenGL's axes and OpenCV's


def poses(count: int = NUM_FRAMES) -> np.ndarray:
    """(F, 4, 4) camera to world, OpenGL's axes: on a circle of radius 4, 1.5 above the point that they look at."""
    result = []
    for index in range(count):
        angle = 0.4 + index * math.tau / count
        back = np.array([4 * math.cos(angle), 4 * math.sin(angle), 1.5])
        position, back = CENTER + back, back / np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
        result.append(pose)
    return np.array(result)


def pixels(index: int, channels: int = 4) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 256, (HEIGHT, WIDTH, channels), dtype=np.uint8)


def write_image(path: Path, index: int, channels: int = 4) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels(index, channels)).save(path)


def write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def lens() -> dict[str, Any]:
    return {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}


def listed(folder: str) -> list[dict[str, Any]]:
    """Frames as `transforms.json` lists them."""
    return [
        {"file_path": f"{folder}/{index:04d}.png", "time": index, "transform_matrix": pose.tolist()}
        for index, pose in enumerate(poses())
    ]


def write_blender(root: Path) -> Path:
    for index in range(NUM_FRAMES):
        write_image(root / f"train/{index:04d}.png", index)
    angle = 2 * math.atan(0.5 * WIDTH / FOCAL)
    fields = {"camera_angle_x": angle, "near": PLANES[0], "far": PLANES[1], "frames": listed("train")}
    write_json(root / "transforms_train.json", fields)
    return root


def write_transforms(root: Path) -> Path:
    for index in range(NUM_FRAMES):
        write_image(root / f"images/{index:04d}.png", index)
    fields = {**lens(), "camera_model": "OPENCV", "near": PLANES[0], "far": PLANES[1], "frames": listed("images")}
    write_json(root / "transforms.json", fields)
    return root


def write_nerfies(root: Path) -> Path:
    """With planes in scene coordinates of another scale."""
    ids = [f"{index:06d}" for index in range(NUM_FRAMES)]
    for index, (name, pose) in enumerate(zip(ids, poses())):
        write_image(root / f"rgb/2x/{name}.png", index)
        camera = {
            "orientation": (pose @ FLIP)[:3, :3].T.tolist(), "position": pose[:3, 3].tolist(), "focal_length": FOCAL,
            "principal_point": [WIDTH / 2, HEIGHT / 2], "skew": 0.0, "pixel_aspect_ratio": 1.0,
            "radial_distortion": [0.0, 0.0, 0.0], "tangential_distortion": [0.0, 0.0], "image_size": [WIDTH, HEIGHT],
        }  # fmt: skip
        write_json(root / f"camera/{name}.json", camera)
    write_json(root / "dataset.json", {"count": NUM_FRAMES, "ids": ids, "train_ids": ids, "val_ids": []})
    write_json(root / "metadata.json", {name: {"warp_id": index} for index, name in enumerate(ids)})
    scale = 0.5
    planes = {"near": PLANES[0] * scale, "far": PLANES[1] * scale}
    write_json(root / "scene.json", {"scale": scale, "center": [1.0, 2.0, 3.0], **planes})
    return root


def llff_rows() -> np.ndarray:
    rows = []
    for pose in poses():
        right, up, back, position = pose[:3].T
        matrix = np.stack([-up, right, back, position, [HEIGHT, WIDTH, FOCAL]], axis=1)
        rows.append([*matrix.ravel(), *PLANES])
    return np.array(rows)


def write_llff(root: Path) -> Path:
    for index in range(NUM_FRAMES):
        write_image(root / f"images/{index:04d}.png", index)
    np.save(root / "poses_bounds.npy", llff_rows())
    return root


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z): the eigenvector of Bar-Itzhack's matrix (2000, eq. 2)."""
    symmetric = np.zeros((4, 4))
    for row in range(3):
        for column in range(3):
            symmetric[row, column] = rotation[row, column] + rotation[column, row]
    trace = np.trace(rotation)
    symmetric[:3, :3] -= trace * np.eye(3)
    symmetric[3, :3] = symmetric[:3, 3] = [
        rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    ]  # fmt: skip
    symmetric[3, 3] = trace
    x, y, z, w = np.linalg.eigh(symmetric / 3)[1][:, -1]
    return np.array([w, x, y, z])


def colmap_images() -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Name, quaternion and translation of each image, world to camera."""
    result = []
    for index, pose in enumerate(poses()):
        to_camera = np.linalg.inv(pose @ FLIP)
        result.append((f"{index:04d}.png", quaternion(to_camera[:3, :3]), to_camera[:3, 3]))
    return result


POINTS = np.array([[0.0, 0.1, 0.2], [0.5, -0.5, 0.0], [1.0, 0.0, -0.25]])


def write_colmap(root: Path, binary: bool = True) -> Path:
    for index in range(NUM_FRAMES):
        write_image(root / f"images/{index:04d}.png", index)
    model = root / "sparse/0"
    model.mkdir(parents=True)
    parameters = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    if not binary:
        numbers = " ".join(repr(float(x)) for x in parameters)
        (model / "cameras.txt").write_text(f"# Camera list\n1 PINHOLE {WIDTH} {HEIGHT} {numbers}\n")
        lines = ["# Image list"]
        for number, (name, rotation, translation) in enumerate(colmap_images(), 1):
            numbers = " ".join(repr(float(x)) for x in (*rotation, *translation))
            lines += [f"{number} {numbers} 1 {name}", "1.5 2.5 -1 3.5 4.5 2"]
        (model / "images.txt").write_text("\n".join(lines) + "\n")
        rows = [f"{i} {x} {y} {z} 255 0 0 0.5 1 0" for i, (x, y, z) in enumerate(POINTS)]
        (model / "points3D.txt").write_text("\n".join(rows) + "\n")
        return root
    cameras = struct.pack("<Qii2Q4d", 1, 1, 1, WIDTH, HEIGHT, *parameters)
    (model / "cameras.bin").write_bytes(cameras)
    images = struct.pack("<Q", NUM_FRAMES)
    for number, (name, rotation, translation) in enumerate(colmap_images(), 1):
        images += struct.pack("<i7di", number, *rotation, *translation, 1) + name.encode() + b"\0"
        images += struct.pack("<Q2dq2dq", 2, 1.5, 2.5, -1, 3.5, 4.5, 2)
    (model / "images.bin").write_bytes(images)
    points = struct.pack("<Q", len(POINTS))
    for number, point in enumerate(POINTS):
        points += struct.pack("<Q3d3BdQii", number, *point, 255, 0, 0, 0.5, 1, 1, 0)
    (model / "points3D.bin").write_bytes(points)
    return root


def write_rig(root: Path) -> Path:
    """Cameras that stand still, of five frames each at two frames a second; the videos are no videos."""
    videos = []
    root.mkdir(parents=True, exist_ok=True)
    for index, pose in enumerate(poses()):
        name = f"train{index:02d}.mp4"
        (root / name).write_bytes(b"no video")
        angle = 2 * math.atan(0.5 * WIDTH / FOCAL)
        video = {"file_name": name, "frame_rate": 2, "frame_num": 5, "camera_angle_x": angle}
        videos.append({**video, "camera_hw": [HEIGHT, WIDTH], "transform_matrix": pose.tolist()})
    fields = {"near": PLANES[0], "far": PLANES[1], "frame_bkg_color": [0.0, 0.25, 1.0], "rot": "Z", "phi": 20.0}
    write_json(root / "info.json", {"train_videos": videos[:3], "test_videos": videos[3:], **fields})
    return root


WRITERS = {
    "blender": write_blender, "transforms": write_transforms, "nerfies": write_nerfies, "llff": write_llff,
    "colmap": write_colmap, "rig": write_rig,
}  # fmt: skip


def frames_of(root: Path, split: str, resolution: int | None = None) -> Frames:
    """A split whose times are in [0, 1], in the files' own units."""
    capture = read_capture(root)
    loaded = load_frames(capture.splits[split], resolution=resolution)
    poses = torch.tensor([frame.pose for frame in loaded.frames], dtype=torch.float64).float()
    times = torch.tensor([0.0 if frame.time is None else frame.time for frame in loaded.frames])
    background = None if loaded.has_alpha else capture.background
    names = tuple(frame.name for frame in loaded.frames)
    planes = capture.planes or (2.0, 6.0)
    return Frames(loaded.images, poses, times, loaded.intrinsics, *planes, background, names)
