"""Scores over time of models that are known to be right, wrong or blind."""

import math

import pytest
import torch
from torch import Tensor

from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.compositing import FieldOutput
from dnerf.deformations import IdentityDeformation
from dnerf.fields import DeformedField
from dnerf.fields.base import RadianceField
from dnerf.rays import Rays, Samples
from dnerf.renderer import Renderer
from dnerf.samplers import Sampler
from dnerf.scenes import AnalyticScene, make_orbiting_balls, make_scene
from dnerf.temporal_evaluation import evaluate_over_time

CAMERA = Camera(Intrinsics.from_angle(32, 32, 0.7), look_at((3.6, 0.4, 1.6)))


class ExactSampler(Sampler):
    """Asks the scene itself."""

    def __init__(self, scene: AnalyticScene) -> None:
        super().__init__()
        self.scene = scene

    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        return self.scene.exact_samples(rays)


def exact(scene: AnalyticScene) -> Renderer:
    return Renderer(scene, ExactSampler(scene))


def test_the_scene_itself_scores_as_its_truth() -> None:
    scene = make_orbiting_balls(density=2000.0)
    scores = evaluate_over_time(exact(scene), CAMERA, scene, num_frames=5)
    assert scores.motion == "exact"
    assert scores.warping_error == pytest.approx(scores.true_warping_error, rel=1e-6)
    assert scores.flicker == scores.true_flicker > 0
    assert scores.temporal_psnr == scores.film_psnr == 100
    # Tracks begin 1e-4 behind the surface; the few that graze it may miss the body and stand still.
    assert scores.track_error < 0.1 * scores.still_track_error
    assert scores.flow_error < 0.1 * scores.still_flow_error
    # At silhouettes the nearest pixel's depth is that of what lies behind: such points count as hidden.
    assert scores.found > 0.8
    assert scores.num_frames == 5
    assert scores.time_step == 0.25
    assert not any(isinstance(value, float) and math.isnan(value) for value in scores.as_dict().values())


class Frozen(RadianceField):
    """The scene as it was at t = 0, at all times."""

    def __init__(self, scene: AnalyticScene) -> None:
        super().__init__()
        self.scene = scene

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.scene.density(positions, 0 * times)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return self.scene(positions, directions, 0 * times)


class FrozenSampler(ExactSampler):
    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        return self.scene.exact_samples(Rays(rays.origins, rays.directions, 0 * rays.times, rays.near, rays.far))


def test_a_model_that_stands_still_scores_as_standing_still() -> None:
    scene = make_scene("orbiting_balls")
    still = Renderer(DeformedField(IdentityDeformation(), Frozen(scene)), FrozenSampler(scene))
    scores = evaluate_over_time(still, CAMERA, scene, num_frames=5)
    assert scores.flow_error == pytest.approx(scores.still_flow_error)
    assert scores.track_error == pytest.approx(scores.still_track_error)
    assert scores.flicker == 0
    assert scores.true_flicker > 0.05
    assert scores.temporal_psnr < 25
    # By its own motion it is perfectly consistent: consistency alone is not correctness.
    alone = evaluate_over_time(still, CAMERA, None, num_frames=5)
    assert alone.motion == "model"
    assert alone.warping_error < 1e-10
    assert alone.depth_consistency < 1e-5
    assert alone.flicker == 0
    assert alone.track_error is None
    assert alone.true_flicker is None


def test_a_flickering_model_is_told_from_the_scene() -> None:
    scene = make_scene("walker")

    class Flickering(type(scene)):
        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            output = super().forward(positions, directions, times)
            lamp = 0.8 + 0.2 * torch.cos(torch.pi * 8 * times)  # every other frame of nine
            return FieldOutput(output.density, output.rgb * lamp[..., None])

    model = exact(Flickering(scene.bodies, scene.box))
    scores = evaluate_over_time(model, CAMERA, scene, num_frames=9)
    assert scores.flicker > 1.5 * scores.true_flicker
    assert scores.warping_error > 3 * scores.true_warping_error
    assert scores.temporal_psnr < 25
    assert scores.flow_error < 0.5 * scores.still_flow_error  # the motion is right


def test_too_short_a_film_is_refused() -> None:
    scene = make_scene("static")
    with pytest.raises(ValueError, match="num_frames must be at least 3, got 2"):
        evaluate_over_time(exact(scene), CAMERA, scene, num_frames=2)
