"""Films of an exact scene: by a phone in a hand, slow and jerky, with drifting exposure; and by a rig that stands."""

import math
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from dnerf.core.cameras import Intrinsics, look_at
from dnerf.core.lenses import Distortion
from dnerf.data.frames import Frames
from dnerf.data.synthetic import render_frames
from dnerf.scenes import AnalyticScene, Wave

PLANES = (0.02, 5.0)
SKY = (0.62, 0.78, 0.95)
ANGLE_X = math.radians(65)
# Around the middle, in radians and world units; harmonics are (amplitude, cycles in the film, phase in turns). The slow
# ones walk, the next are steps, the last the hand's tremor.
AZIMUTH = Wave(-0.5 * math.pi, ((0.75, 0.8, -0.2), (0.12, 2.7, 0.1), (0.01, 13.0, 0.3), (0.002, 47.0, 0.6)))
RADIUS = Wave(0.36, ((0.04, 1.3, 0.4), (0.006, 13.0, 0.8)))
HEIGHT = Wave(0.01, ((0.05, 1.1, 0.7), (0.006, 13.0, 0.05), (0.001, 41.0, 0.2)))
ASIDE = Wave(0.0, ((0.03, 1.7, 0.15), (0.004, 11.0, 0.5), (0.0015, 53.0, 0.9)))
ABOVE = Wave(-0.07, ((0.02, 1.9, 0.55), (0.004, 12.0, 0.35), (0.0015, 43.0, 0.4)))
ROLL = Wave(0.0, ((0.04, 2.3, 0.25), (0.008, 17.0, 0.0)))
EXPOSURE = Wave(0.0, ((0.2, 1.2, 0.1), (0.05, 3.7, 0.6)))  # in stops
TINT = Wave(0.0, ((0.06, 0.9, 0.3),))  # red gains what blue loses, in stops


def phone_lens(width: int) -> Intrinsics:
    """A wide lens with barrel distortion, 16 : 9."""
    lens = Intrinsics.from_angle(width, round(width * 9 / 16), ANGLE_X)
    return replace(lens, distortion=Distortion("opencv", (-0.08, 0.03)))


def phone_poses(times: Tensor) -> Tensor:
    """Where a hand holds the phone at times (F,) of the film: (F, 4, 4), looking at about the scene's middle."""
    poses = []
    waves = (AZIMUTH, RADIUS, HEIGHT, ASIDE, ABOVE, ROLL)
    for azimuth, radius, height, aside, above, roll in zip(*(wave(times).tolist() for wave in waves)):
        pose = look_at((radius * math.cos(azimuth), radius * math.sin(azimuth), height), (aside, 0.0, above))
        turn = torch.eye(4)
        turn[:2, :2] = torch.tensor([[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]])
        poses.append(pose @ turn)
    return torch.stack(poses)


def phone_gains(times: Tensor) -> Tensor:
    """Factors (F, 3) that exposure and white balance put on the colours at times (F,)."""
    stops, tint = EXPOSURE(times), TINT(times)
    return torch.stack([stops + tint, stops, stops - tint], dim=-1).exp2()


def film_by_phone(scene: AnalyticScene, width: int, *, num_train: int, num_test: int) -> dict[str, Frames]:
    """The phone's frames, "train", and held-out ones of a steady camera between its places, "test".

    The held-out frames have no distortion, the exposure 1, and times in the middle between the film's.
    """
    times = torch.linspace(0, 1, num_train)
    render = partial(render_frames, scene, background=SKY, planes=PLANES, oversampling=2)
    train = render(phone_poses(times), times, phone_lens(width), gains=phone_gains(times))
    times = (torch.arange(num_test) + 0.5) / num_test
    poses = [_inwards(angle, 0.03) for angle in (0.6 * torch.cos(2 * math.pi * times)).tolist()]
    lens = replace(phone_lens(width), distortion=None)
    return {"train": train, "test": render(torch.stack(poses), times, lens, gains=torch.ones(num_test, 3))}


def film_by_rig(
    scene: AnalyticScene, width: int, *, num_cameras: int, num_train: int, num_test: int
) -> dict[str, Frames]:  # fmt: skip
    """Frames of cameras that stand on an arc, "train", and of one between them, "test", which has the exposure 1.

    Each camera is exposed in its own way, by up to 0.35 stops, and takes an image at each of `num_train` times.
    """
    numbers = torch.arange(num_cameras).double()
    angles = 0.8 * (2 * numbers / max(num_cameras - 1, 1) - 1)
    stops, tint = 0.35 * torch.cos(2.4 * numbers), 0.08 * torch.sin(1.7 * numbers)
    gains = torch.stack([stops + tint, stops, stops - tint], dim=-1).float().exp2()
    poses = [_inwards(angle, -0.02 + 0.08 * (k % 2)) for k, angle in enumerate(angles.tolist())]
    render = partial(render_frames, scene, background=SKY, planes=PLANES, oversampling=2)
    lens = replace(phone_lens(width), distortion=None)
    shown = torch.stack(poses).repeat_interleave(num_train, 0), torch.linspace(0, 1, num_train).repeat(num_cameras)
    train = render(*shown, lens, gains=gains.repeat_interleave(num_train, 0))
    held_out = torch.stack([_inwards(0.13, 0.03)] * num_test), torch.linspace(0, 1, num_test)
    return {"train": train, "test": render(*held_out, lens, gains=torch.ones(num_test, 3))}


def _inwards(angle: float, height: float) -> Tensor:
    """A pose (4, 4) at 0.37 from the middle, so many radians from -y, that looks at it."""
    place = (0.37 * math.sin(angle), -0.37 * math.cos(angle), height)
    return look_at(place, (0.0, 0.0, -0.07))
