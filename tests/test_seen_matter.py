"""Points of matter that pictures show: on surfaces, as many as pixels show of them, at the frames' times."""

import pytest
import torch

from dnerf.data import SyntheticData
from dnerf.deformations import IdentityDeformation
from dnerf.fields import DeformedField
from dnerf.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.seen_matter import seen_matter

NUM_RAYS = 20_000


@pytest.fixture(scope="module")
def data() -> SyntheticData:
    return SyntheticData(make_scene("orbiting_balls"), resolution=24, num_train=6, num_val=1, num_test=1)


@pytest.fixture(scope="module")
def renderer(data: SyntheticData) -> Renderer:
    field = DeformedField(IdentityDeformation(), data.scene)
    return Renderer(field, StratifiedSampler(128, data.scene.box.tolist())).eval()


def test_matter_lies_in_bodies_where_pixels_show_it(data: SyntheticData, renderer: Renderer) -> None:
    frames = data.frames("train")
    seen = seen_matter(renderer, frames, NUM_RAYS, torch.Generator().manual_seed(0))
    assert set(seen.times.tolist()) == set(frames.times.tolist())
    # A sample's interval begins before the surface and its middle may lie just before it.
    assert data.scene.contains(seen.positions, seen.times).any(-1).float().mean() > 0.9
    opacity = torch.stack(
        [renderer.render_image(frames.camera(k), float(frames.times[k])).opacity.mean() for k in range(len(frames))]
    )
    expected = float(opacity.mean()) * NUM_RAYS
    assert len(seen.times) == pytest.approx(expected, abs=4 * expected**0.5)


def test_the_same_generator_gives_the_same_matter(data: SyntheticData, renderer: Renderer) -> None:
    first, second, other = (
        seen_matter(renderer, data.frames("train"), 500, torch.Generator().manual_seed(seed)) for seed in (3, 3, 4)
    )
    assert torch.equal(first.positions, second.positions)
    assert first.positions.shape != other.positions.shape or not torch.equal(first.positions, other.positions)


def test_no_rays_are_refused(data: SyntheticData, renderer: Renderer) -> None:
    with pytest.raises(ValueError, match="num_rays must be > 0"):
        seen_matter(renderer, data.frames("train"), 0, torch.Generator())
