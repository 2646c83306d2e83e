"""Exposures of cameras are learnt apart from the scene, and are not in images."""

import math

import pytest
import torch
from torch import nn

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.data import film_by_rig
from dnerf.rendering import Exposure, Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene

TIMES = torch.linspace(0, 1, 41)
ORIGINS = torch.zeros(41, 3)
RIG = torch.tensor([[0.0, 0, 3], [3, 0, 0], [0, 3, 0]])


def drifting(factors: list[list[float]]) -> Exposure:
    exposure = Exposure(len(factors))
    exposure.logarithms.data[0] = torch.tensor(factors).log()
    return exposure


def test_colours_are_as_they_are_at_first_and_gradients_flow() -> None:
    exposure, rgb = Exposure(), torch.rand(41, 3)
    torch.testing.assert_close(exposure(rgb, ORIGINS, TIMES), rgb, rtol=0, atol=0)
    (exposure(rgb, ORIGINS, TIMES) * (TIMES[:, None] - 0.5)).sum().backward()
    assert exposure.logarithms.grad is not None
    assert float(exposure.logarithms.grad.abs().max()) > 0.1


def test_logarithms_of_factors_are_linear_between_times() -> None:
    exposure = drifting([[2.0, 1.0, 0.5], [1.0, 1.0, 1.0], [0.5, 1.0, 2.0]])
    for time, factors in ((0.0, (2, 1, 0.5)), (0.25, (2**0.5, 1, 2**-0.5)), (0.5, (1, 1, 1)), (1.0, (0.5, 1, 2))):
        shown = exposure(torch.full((1, 3), 0.4), torch.zeros(1, 3), torch.tensor([time]))
        torch.testing.assert_close(shown, 0.4 * torch.tensor([factors]), rtol=1e-6, atol=0)


def test_brightness_as_a_whole_is_the_scene_s() -> None:
    factors = torch.rand(7, 3) + 0.5
    shown, brighter = (drifting(x.tolist())(torch.full((41, 3), 0.5), ORIGINS, TIMES) for x in (factors, 3 * factors))
    torch.testing.assert_close(shown, brighter)


def test_its_derivatives_are_right() -> None:
    exposure = Exposure(4, 2).double()
    exposure.see(torch.linspace(0, 1, 12), RIG[[0, 1] * 6])
    rgb = torch.rand(9, 3, dtype=torch.float64, requires_grad=True)
    times, origins = torch.linspace(0.01, 0.97, 9, dtype=torch.float64), RIG[[0, 1, 1] * 3].double()

    def shown(rgb: torch.Tensor, logarithms: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(exposure, {"logarithms": logarithms}, (rgb, origins, times))

    assert torch.autograd.gradcheck(shown, (rgb, torch.rand(2, 4, 3, dtype=torch.float64, requires_grad=True)))


def test_a_drift_is_found_beside_colours_that_are_learnt_too() -> None:
    """Eight places, each seen at all times: the exact factors, up to one for all times, which is the colours'."""
    colors, truth = torch.rand(8, 3) * 0.6 + 0.2, torch.exp(0.2 * torch.sin(2 * math.pi * TIMES))[:, None]
    exposure, learnt = Exposure(21), nn.Parameter(torch.full((8, 3), 0.5))
    optimizer = torch.optim.Adam([*exposure.parameters(), learnt], lr=0.01)
    for _ in range(600):
        optimizer.zero_grad()
        shown = torch.stack([exposure(color.expand(41, 3), ORIGINS, TIMES) for color in learnt])
        (shown - colors[:, None] * truth).square().mean().backward()
        optimizer.step()
    scale = learnt.detach() / colors
    found = exposure(torch.ones(41, 3), ORIGINS, TIMES).detach()
    torch.testing.assert_close(found * scale.mean(), truth.expand(41, 3), rtol=0.02, atol=0)
    torch.testing.assert_close(scale, scale.mean().expand(8, 3), rtol=0.02, atol=0)


def test_it_is_in_training_and_not_in_images() -> None:
    exposure = drifting([[2.0, 1.0, 0.5], [0.5, 1.0, 2.0]])
    plain = Renderer(make_scene("static"), StratifiedSampler(16))
    exposed = Renderer(make_scene("static"), StratifiedSampler(16), exposure=exposure)
    camera = Camera(Intrinsics.from_angle(4, 4, 0.7), look_at((4.0, 0.0, 0.0)))
    assert torch.equal(exposed.render_image(camera, 0.0).rgb, plain.render_image(camera, 0.0).rgb)
    seen = [model(camera.rays(0.0), generator=torch.Generator().manual_seed(0)).rgb for model in (exposed, plain)]
    torch.testing.assert_close(seen[0], seen[1] * torch.tensor([2.0, 1.0, 0.5]))


def seen(places: torch.Tensor) -> Exposure:
    exposure = Exposure(2, 4)
    exposure.see(torch.linspace(0, 1, len(places)), places)
    return exposure


def test_each_camera_of_a_rig_has_factors_of_its_own_whose_mean_is_one() -> None:
    exposure = seen(RIG[[0, 1, 2] * 5] + 0.01 * torch.rand(15, 3))
    exposure.logarithms.data[:3] = torch.tensor([2.0, 1.0, 0.5]).log()[:, None, None]
    order = [int(exposure.places[:3].isclose(place, atol=0.02).all(1).nonzero()) for place in RIG]
    shown = exposure(torch.ones(3, 3), RIG, torch.tensor([0.0, 0.3, 1.0]))
    torch.testing.assert_close(shown, torch.tensor([2.0, 1.0, 0.5])[order][:, None].expand(3, 3))
    kept = exposure.places.clone()
    exposure.see(TIMES, torch.rand(41, 3))
    assert torch.equal(exposure.places, kept)


def test_the_cameras_of_a_film_by_a_rig_are_found_and_exposed_differently() -> None:
    frames = film_by_rig(make_scene("courtyard"), 16, num_cameras=3, num_train=4, num_test=2)
    exposure = Exposure()
    exposure.see(frames["train"].times, frames["train"].poses[:, :3, 3])
    assert int(exposure.is_used.sum()) == 3 * 2  # each at half as many times as it has frames
    first, second = (frames["train"].image(i).mean() for i in (0, 4))  # of two cameras
    assert second < 0.9 * first  # 0.35 cos 2.4 of a stop, and 0.35


@pytest.mark.parametrize("places", [torch.rand(41, 3), RIG, torch.zeros(8, 3)])
def test_a_camera_that_moves_or_is_alone_is_one(places: torch.Tensor) -> None:
    exposure = seen(places)
    exposure.logarithms.data[0, :, 0] = torch.tensor([4.0, 1.0]).log()
    shown = exposure(torch.ones(2, 3), torch.rand(2, 3), torch.tensor([0.0, 1.0]))
    torch.testing.assert_close(shown, torch.tensor([[2.0, 1, 1], [0.5, 1, 1]]))


@pytest.mark.parametrize(("numbers", "said"), [((1, 4), "num_times must be at least 2"), ((2, 0), "most_cameras")])
def test_too_few_are_refused(numbers: tuple[int, int], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Exposure(*numbers)
