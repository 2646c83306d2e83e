"""Scores over time of models that are known to be right, wrong or blind."""

import pytest
import torch
from reference import ExactSampler, FormulaField, exact
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.compositing import FieldOutput
from dnerf.core.rays import Rays, Samples
from dnerf.deformations import DisplacementDeformation, IdentityDeformation
from dnerf.evaluation import evaluate_over_time
from dnerf.fields import DeformedField, RadianceField, TimeDependence
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import AnalyticScene, make_scene
from dnerf.scenes.library.orbiting_balls import make_orbiting_balls

CAMERA = Camera(Intrinsics.from_angle(32, 32, 0.7), look_at((3.6, 0.4, 1.6)))


def test_the_scene_itself_scores_as_its_truth() -> None:
    scene = make_orbiting_balls(density=2000.0)
    scores = evaluate_over_time(exact(scene), CAMERA, scene, num_frames=5)
    assert scores.motion == "exact"
    assert scores.warping_error == pytest.approx(scores.true_warping_error, rel=1e-6)
    assert scores.flicker == scores.true_flicker > 0
    assert scores.temporal_psnr == scores.film_psnr == 100
    assert scores.depth_consistency == pytest.approx(scores.true_depth_consistency, rel=1e-6)
    assert 0 < scores.flow_error == pytest.approx(scores.true_flow_error, rel=1e-6)
    # Tracks begin 1e-4 behind the surface; the few that graze it may miss the body and stand still.
    assert scores.track_error < 0.1 * scores.still_track_error
    assert scores.flow_error < 0.1 * scores.still_flow_error
    # At silhouettes the nearest pixel's depth is that of what lies behind: such points count as hidden.
    assert scores.found > 0.8
    assert scores.num_frames == 5
    assert scores.time_step == 0.25
    assert not any(value is None or value != value for value in scores.as_dict().values())


@pytest.mark.parametrize("name", ["orbiting_balls", "twisting_block"])
def test_depth_beside_the_background_is_left_out(name: str) -> None:
    """Bilinear reads would mix a surface's depth with the 0 of empty pixels: 0.154 and 0.102 without the mask."""
    scene = make_scene(name)
    assert evaluate_over_time(exact(scene), CAMERA, scene, num_frames=5).depth_consistency < 0.02


class Empty(FormulaField, TimeDependence):
    """Nothing at all."""

    is_static = True


@pytest.mark.parametrize("is_exact", [True, False])
def test_what_an_empty_model_does_not_show_is_not_measured(is_exact: bool) -> None:
    scene = make_scene("walker")
    nothing = Empty(lambda positions: 0 * positions[..., 0], lambda positions, directions, times: 0 * positions)
    empty = Renderer(DeformedField(DisplacementDeformation(1, 4, ()), nothing), StratifiedSampler(8))
    scores = evaluate_over_time(empty, CAMERA, scene if is_exact else None, num_frames=3).as_dict()
    unknown = {"warping_error", "depth_consistency"}
    unknown |= {"flow_error", "still_flow_error", "flow_outliers", "scene_flow_error"} if is_exact else {"found"}
    assert {name for name, value in scores.items() if value is None} == unknown
    assert scores.get("found") == (0 if is_exact else None)


def test_an_unknown_motion_is_not_measured() -> None:
    """The scene in disguise: right at all times, but nobody says how it moves."""

    class Disguised(Frozen):
        is_static = False

        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            return self.scene(positions, directions, times)

    scene = make_scene("walker")
    scores = evaluate_over_time(Renderer(Disguised(scene), ExactSampler(scene)), CAMERA, scene, num_frames=3)
    assert scores.warping_error == pytest.approx(scores.true_warping_error)
    assert scores.found == 0
    assert scores.flow_error is scores.flow_outliers is scores.scene_flow_error is None
    assert scores.track_error is scores.track_accuracy is None
    assert scores.true_flow_error > 0


def test_a_view_that_shows_nothing_is_not_measured_and_too_short_a_film_refused() -> None:
    scene = make_scene("walker")
    away = Camera(CAMERA.intrinsics, look_at((3.6, 0.4, 1.6), (7.2, 0.8, 3.2)))
    scores = evaluate_over_time(exact(scene), away, scene, num_frames=3)
    assert scores.found is scores.warping_error is scores.flow_error is scores.track_error is None
    with pytest.raises(ValueError, match="num_frames must be at least 3, got 2"):
        evaluate_over_time(exact(scene), CAMERA, scene, num_frames=2)


class Frozen(RadianceField, TimeDependence):
    """The scene as it was at t = 0, at all times."""

    is_static = True

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
