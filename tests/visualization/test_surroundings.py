"""Films stand where the training cameras stand."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from dnerf.core.cameras import Intrinsics, look_at
from dnerf.core.lenses import Distortion
from dnerf.data.scene_record import CameraSet
from dnerf.visualization import Surroundings

LENS = Intrinsics.from_angle(40, 30, 0.7)


def ring(
    degrees: float, count: int = 24, radius: float = 3.0, rise: float = 0.5, around: tuple = (0.0, 0.0, 0.0)
) -> Tensor:
    angles = [math.radians(degrees) * i / count for i in range(count)]
    eyes = [(math.cos(rise) * math.cos(a), math.cos(rise) * math.sin(a), math.sin(rise)) for a in angles]
    return torch.stack([look_at([c + radius * e for c, e in zip(around, eye)], around) for eye in eyes])


def cameras(poses: Tensor, lens: Intrinsics = LENS) -> CameraSet:
    return CameraSet(poses, torch.zeros(len(poses)), (lens,) * len(poses))


def test_a_ring_of_cameras_gives_its_own_middle_distance_and_height() -> None:
    found = Surroundings.of(cameras(ring(360)))
    assert found.target == (0.0, 0.0, 0.0)
    assert (found.radius, found.elevation) == pytest.approx((3.0, 0.5), abs=1e-5)
    assert found.sway() is None


def test_cameras_that_look_elsewhere_are_followed_there() -> None:
    found = Surroundings.of(cameras(ring(360, around=(30.0, 0.0, 0.0))))
    assert found.target == pytest.approx((30.0, 0.0, 0.0), abs=1e-3)
    assert found.radius == pytest.approx(3.0, abs=1e-3)


def test_cameras_on_one_side_are_swayed_among() -> None:
    middle, half = Surroundings.of(cameras(ring(90, 10))).sway()
    assert math.degrees(middle) == pytest.approx(40.5, abs=1e-3)
    assert math.degrees(half) == pytest.approx(40.5, abs=1e-3)
    still = Surroundings.of(cameras(ring(360)[:1]))
    assert still.sway() == pytest.approx((0.0, 0.0), abs=1e-6)


def test_the_most_frequent_lens_is_taken_without_its_distortion() -> None:
    bent = replace(LENS, distortion=Distortion(radial=(0.05,)))
    poses = ring(360, 5)
    mixed = CameraSet(poses, torch.zeros(5), (LENS, bent, replace(LENS, width=20), bent, LENS))
    assert Surroundings.of(mixed).intrinsics == LENS
    assert Surroundings.of(cameras(poses, bent)).intrinsics == LENS
