"""Motion that a model has recovered, against scenes that move exactly."""

import math
from collections.abc import Callable

import pytest
import torch
from reference import FormulaField
from torch import Tensor

from benchmarks.closed_flows import Rotation
from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.data import render_exact
from dnerf.deformations import CachedDeformation, DisplacementDeformation, FlowDeformation, IdentityDeformation
from dnerf.fields import DeformedField, GridField, NeRFField
from dnerf.motion import MotionVectors, carry, follow, motion_model, motion_vectors, render_motion
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import AnalyticScene, Ball, Body, Plain, Spin

CAMERA = Camera(Intrinsics.from_angle(48, 40, 0.5), look_at((0.0, -4.0, 3.0)))


def spinning_ball() -> AnalyticScene:
    """A ball of radius 0.8 that turns about z by two radians while t goes from 0 to 1."""
    return AnalyticScene(
        [Body(Ball(0.8), Plain((0.8, 0.2, 0.1)), Spin(turns=2 / (2 * math.pi)), 200.0)],
        box=((-0.8, -0.8, -0.8), (0.8, 0.8, 0.8)),
    )


class Turning(FlowDeformation):
    """The spinning ball's motion as a flow."""

    def __init__(self) -> None:
        super().__init__(Rotation(2.0), 0.0, num_steps=16)


class TurningWithoutInverse(DisplacementDeformation):
    """The same motion, known from world to canonical only."""

    def __init__(self) -> None:
        super().__init__(1, 4, ())
        self.flow = Turning()

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.flow(positions, times)


MODELS = {"scene": spinning_ball, "flow": Turning, "displacement": TurningWithoutInverse}
every_model = pytest.mark.parametrize("name", MODELS)


def inside_points(count: int) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3), dim=-1) * torch.rand(count, 1) * 0.75


def turned(positions: Tensor, elapsed: Tensor | float) -> Tensor:
    elapsed = torch.as_tensor(elapsed, dtype=positions.dtype).expand(positions.shape[:-1])
    return Rotation(2.0).carry(positions, torch.zeros_like(elapsed), elapsed)


@every_model
def test_points_are_carried_as_the_ball_turns(name: str) -> None:
    positions = inside_points(200)
    start, end = torch.rand(200), torch.rand(200)
    moved, residual = carry(MODELS[name](), positions, start, end)
    # RK4 with 16 steps over at most two radians.
    torch.testing.assert_close(moved, turned(positions, end - start), rtol=0, atol=1e-4)
    assert residual.max() < 1e-5


def some_grid(**changing: object) -> GridField:
    return GridField(((-1.0,) * 3, (1.0,) * 3), (4,), 2, hidden_features=4, num_layers=1, **changing)  # type: ignore[arg-type]


def test_motion_is_that_of_the_deformation_or_of_the_scene() -> None:
    scene, flow = spinning_ball(), Turning()
    field = DeformedField(CachedDeformation(flow, [[-1.0] * 3, [1.0] * 3], 4), some_grid(temporal_terms=2))
    assert motion_model(field) is flow
    assert motion_model(Renderer(field, StratifiedSampler(4))) is flow
    assert motion_model(scene) is scene
    assert motion_model(DeformedField(IdentityDeformation(), scene)) is scene


def silent() -> FormulaField:
    """A field that does not say whether it changes."""
    return FormulaField(lambda x: 50.0 * (x.norm(dim=-1) < 0.8), lambda x, *_: torch.full_like(x, 0.5))


@pytest.mark.parametrize("wrap", [lambda field: field, lambda field: DeformedField(IdentityDeformation(), field)])
def test_static_fields_stand_still_and_what_changes_otherwise_is_unknown(wrap: Callable) -> None:
    for static in (some_grid(), NeRFField(1, 4, ())):
        assert isinstance(motion_model(wrap(static)), IdentityDeformation)
    for changing in (some_grid(temporal_terms=2), silent()):
        assert motion_model(wrap(changing)) is None


def test_an_unknown_motion_is_not_a_number() -> None:
    renderer = Renderer(silent(), StratifiedSampler(64, ((-0.9,) * 3, (0.9,) * 3)))
    first, _, vectors = render_motion(renderer, CAMERA, 0.2, 0.3)
    assert (first.opacity > 0.5).any()
    assert not (vectors.valid | vectors.visible | vectors.found).any()
    for values in (vectors.flow_2d, vectors.flow_3d, vectors.residual):
        assert values.isnan().all()
    with pytest.raises(ValueError, match="the motion of this field is unknown"):
        carry(motion_model(renderer), torch.zeros(5, 3), 0.0, 1.0)


@every_model
def test_motion_is_found_in_inference_mode(name: str) -> None:
    model = MODELS[name]()
    with torch.inference_mode():
        positions = inside_points(20)
        # Far apart, so that a fixed-point inverse needs the Jacobian.
        moved, _ = carry(model, positions, 0.0, 1.0)
        tracks = follow(model, positions, 0.0, torch.tensor([0.0, 1.0]))
    torch.testing.assert_close(moved, turned(positions, 1.0), rtol=0, atol=2e-4)
    torch.testing.assert_close(tracks.positions[1], moved, rtol=0, atol=2e-4)


@every_model
def test_tracks_follow_points_over_all_times_in_any_order(name: str) -> None:
    positions = inside_points(20)
    times = torch.tensor([0.9, 0.0, 0.4, 0.45, 1.0])
    none, tracks = (follow(MODELS[name](), positions, 0.4, some) for some in (times[:0], times))
    assert (none.positions.shape, none.residuals.shape) == ((0, 20, 3), (0, 20))
    assert tracks.positions.shape == (5, 20, 3)
    assert tracks.residuals.shape == (5, 20)
    for i, time in enumerate(times.tolist()):
        torch.testing.assert_close(tracks.positions[i], turned(positions, time - 0.4), rtol=0, atol=1e-4)


def exact_views(start: float, end: float) -> tuple[Tensor, Tensor, Tensor]:
    """Depth and opacity of the ball, and its depth at the other time."""
    scene = spinning_ball()
    _, opacity, depth = render_exact(scene, CAMERA.rays(start))
    _, other_opacity, other_depth = render_exact(scene, CAMERA.rays(end))
    other_depth = torch.where(other_opacity > 0.5, other_depth, torch.inf)
    return depth.reshape(40, 48), opacity.reshape(40, 48), other_depth.reshape(40, 48)


@every_model
def test_motion_vectors_of_a_turning_ball_have_their_closed_form(name: str) -> None:
    start, end = 0.2, 0.3
    depth, opacity, other_depth = exact_views(start, end)
    found = motion_vectors(MODELS[name](), CAMERA, start, end, depth, opacity, other_depth=other_depth)
    assert isinstance(found, MotionVectors)
    assert torch.equal(found.valid, opacity >= 0.5)
    assert 100 < int(found.valid.sum()) < found.valid.numel()
    points = found.positions[found.valid]
    # Seen from outside, the ball's surface.
    torch.testing.assert_close(points.norm(dim=-1), torch.full_like(points[:, 0], 0.8), rtol=0, atol=2e-2)
    expected = turned(points, end - start)
    torch.testing.assert_close(found.flow_3d[found.valid], expected - points, rtol=0, atol=1e-4)
    pixels = CAMERA.project(expected)[0] - CAMERA.project(points)[0]
    torch.testing.assert_close(found.flow_2d[found.valid], pixels, rtol=0, atol=1e-2)
    assert found.flow_2d[found.valid].norm(dim=-1).max() > 2
    for values in (found.flow_2d, found.flow_3d, found.residual):
        assert values[~found.valid].isnan().all()
        assert values[found.valid].isfinite().all()


def test_pixels_of_motion_start_at_their_own() -> None:
    depth, opacity, _ = exact_views(0.2, 0.2)
    found = motion_vectors(spinning_ball(), CAMERA, 0.2, 0.2, depth, opacity)
    pixels, _ = CAMERA.project(found.positions[found.valid])
    rows, columns = found.valid.nonzero().unbind(-1)
    torch.testing.assert_close(pixels, torch.stack([columns, rows], -1).float(), rtol=0, atol=1e-3)
    assert torch.equal(found.valid, found.visible)


def test_a_surface_that_turns_away_is_hidden() -> None:
    start, end = 0.0, 1.0
    depth, opacity, other_depth = exact_views(start, end)
    found = motion_vectors(spinning_ball(), CAMERA, start, end, depth, opacity, other_depth=other_depth)
    points = turned(found.positions[found.valid], end - start)
    to_eye = torch.nn.functional.normalize(CAMERA.pose[:3, 3] - points, dim=-1)
    facing = (torch.nn.functional.normalize(points, dim=-1) * to_eye).sum(-1)
    visible = found.visible[found.valid]
    # The horizon of a ball is where its surface turns from the eye. Depth is that of the nearest pixel, which on a
    # slanted surface is off by more than the tolerance.
    assert visible[facing > 0.7].all()
    assert not visible[facing < -0.3].any()
    assert (~visible).sum() > 20


def test_motion_out_of_the_image_is_valid_but_not_visible() -> None:
    depth, opacity, _ = exact_views(0.0, 0.0)
    away = Camera(CAMERA.intrinsics, look_at((0.0, -4.0, 3.0), (3.0, 0.0, 0.0)))
    found = motion_vectors(spinning_ball(), CAMERA, 0.0, 0.1, depth, opacity, other_camera=away)
    assert found.valid.any()
    assert not found.visible.any()
    behind = Camera(CAMERA.intrinsics, look_at((0.0, -4.0, 3.0), (0.0, -8.0, 6.0)))
    assert not motion_vectors(spinning_ball(), CAMERA, 0.0, 0.1, depth, opacity, other_camera=behind).valid.any()


def test_chunks_do_not_change_motion() -> None:
    depth, opacity, _ = exact_views(0.2, 0.3)
    whole, parts = (motion_vectors(Turning(), CAMERA, 0.2, 0.3, depth, opacity, chunk=chunk) for chunk in (10**6, 100))
    torch.testing.assert_close(whole.flow_3d, parts.flow_3d, rtol=0, atol=1e-6, equal_nan=True)


def test_rendered_motion_is_that_of_the_field() -> None:
    field = DeformedField(Turning(), spinning_ball().float())
    renderer = Renderer(field, StratifiedSampler(256, ((-0.9, -0.9, -0.9), (0.9, 0.9, 0.9))))
    with torch.inference_mode():
        first, second, vectors = render_motion(renderer, CAMERA, 0.2, 0.3, chunk=500)
    assert first.rgb.shape == second.rgb.shape == (40, 48, 3)
    points = vectors.positions[vectors.valid]
    torch.testing.assert_close(vectors.flow_3d[vectors.valid], turned(points, 0.1) - points, rtol=0, atol=1e-4)
    # A ball seen from the front hides little of itself when it turns by a tenth of a radian or two.
    assert vectors.visible.sum() > 0.85 * vectors.valid.sum()


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"depth must have shape \(40, 48\)"):
        motion_vectors(Turning(), CAMERA, 0.0, 1.0, torch.zeros(4, 4), torch.zeros(40, 48))
    with pytest.raises(ValueError, match=r"times must have shape \(5,\), got \(4,\)"):
        carry(Turning(), torch.zeros(5, 3), torch.zeros(4), 0.0)
    with pytest.raises(ValueError, match=r"times must have shape \(T,\)"):
        follow(Turning(), torch.zeros(5, 3), 0.0, torch.zeros(1, 1))
