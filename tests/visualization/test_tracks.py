"""Images of tracks: trails lie where points were."""

import pytest
import torch
from reference import fog
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.deformations import Deformation
from dnerf.fields import DeformedField, GridField
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.visualization.tracks import draw_tracks, render_tracks, track_colors, visible_points

CAMERA = Camera(Intrinsics.from_angle(60, 50, 0.69), look_at((0.0, -3.5, 1.5)))


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    scene = make_scene("orbiting_balls")
    return Renderer(scene, StratifiedSampler(256, scene.box.tolist())).eval()


def test_a_trail_is_drawn_along_its_known_pixels_and_nowhere_else() -> None:
    image = torch.zeros(40, 60, 3)
    pixels = torch.tensor([[[10.0, 20.0]], [[50.0, 20.0]]])
    drawn = draw_tracks(image, pixels, torch.tensor([True]), [(255, 0, 0)])
    assert drawn.shape == (40, 60, 3)
    red = drawn[..., 0].float()
    assert (red[20, 12:49] > 200).all()
    # The line is 1.5 pixels wide, its end a dot of radius 1.8; resampling spreads both by two pixels.
    assert torch.count_nonzero(red[:15]) == 0
    assert torch.count_nonzero(red[26:]) == 0
    assert torch.count_nonzero(red[:, :6]) == 0
    assert torch.count_nonzero(drawn[..., 1:]) == 0
    places = torch.tensor([[5.0, 20], [20, 20], [torch.nan, torch.nan], [40, 20], [55, 20]])
    drawn = draw_tracks(image, places[:, None], torch.tensor([True]), [(255, 0, 0)])[20, :, 0].float()
    assert (drawn[7:18] > 200).all()
    assert (drawn[43:53] > 200).all()
    assert torch.count_nonzero(drawn[24:36]) == 0


def test_hidden_points_are_left_out() -> None:
    image = torch.rand(20, 20, 3)
    pixels = torch.full((3, 1, 2), 10.0)
    without = draw_tracks(image, pixels[:, :0], torch.zeros(0, dtype=torch.bool), [])
    assert torch.equal(draw_tracks(image, pixels, torch.tensor([False]), [(255, 0, 0)]), without)
    assert not torch.equal(draw_tracks(image, pixels, torch.tensor([True]), [(255, 0, 0)]), without)


def test_visible_points_lie_on_surfaces_and_none_is_named(renderer: Renderer) -> None:
    points = visible_points(renderer, CAMERA, 0.0, 5)
    assert len(points) > 5
    inward = points + 0.02 * torch.nn.functional.normalize(points - CAMERA.pose[:3, 3], dim=-1)
    assert renderer.field.contains(inward, torch.zeros(len(points))).any(-1).all()
    away = Camera(CAMERA.intrinsics, look_at((0.0, -3.5, 1.5), (0.0, -7.0, 3.0)))
    with pytest.raises(ValueError, match="the image shows no surface at a spacing of 5 pixels"):
        visible_points(renderer, away, 0.0, 5)


def test_tracks_are_those_of_the_scene_drawn_at_some_times_the_last_among_them(renderer: Renderer) -> None:
    points = visible_points(renderer, CAMERA, 0.0, 10)
    tracks, images = render_tracks(renderer, CAMERA, points, 0.0, [0.0, 0.1, 0.2])
    torch.testing.assert_close(tracks.positions[2], renderer.field.advect(points, 0.0, 0.2))
    frames = list(images)
    assert [frame.shape for frame in frames] == [(50, 60, 3)] * 3
    plain = renderer.render_image(CAMERA, 0.2).rgb
    changed = (frames[2].float() / 255 - plain).abs().amax(-1) > 0.3
    pixels = CAMERA.project(tracks.positions[2])[0].round().long()
    heads = changed[pixels[:, 1].clamp(0, 49), pixels[:, 0].clamp(0, 59)]
    assert heads.any()
    times = [0.0, 0.05, 0.1, 0.15, 0.2, 0.25]
    frames, some = (list(render_tracks(renderer, CAMERA, points, 0.0, times, every=n)[1]) for n in (1, 2))
    assert len(some) == 3
    assert all(torch.equal(one, other) for one, other in zip(some, frames[1::2]))


@pytest.mark.parametrize(
    ("size", "num_visible", "num_colors", "message"),
    [
        ((1, 2, 2), 2, 1, "colors must be 2, one per point, got 1"),
        ((1, 2, 2), 3, 2, r"visible must have shape \(2,\)"),
        ((0, 1, 2), 1, 1, "pixels must be of one time at least, got none"),
    ],
)
def test_wrong_shapes_are_named(size: tuple, num_visible: int, num_colors: int, message: str) -> None:
    visible, colors = torch.ones(num_visible, dtype=torch.bool), [(0, 0, 0)] * num_colors
    with pytest.raises(ValueError, match=message):
        draw_tracks(torch.zeros(4, 4, 3), torch.zeros(size), visible, colors)


def test_tracks_of_an_unknown_motion_are_refused() -> None:
    field = GridField(((-1.0,) * 3, (1.0,) * 3), (4,), 2, hidden_features=4, num_layers=1, temporal_terms=2)
    with pytest.raises(ValueError, match="renderer must have a motion that is known"):
        render_tracks(Renderer(field, StratifiedSampler(4)), CAMERA, torch.zeros(1, 3), 0.0, [0.0, 1.0])


def test_colors_are_plain_bytes() -> None:
    colors = track_colors(torch.randn(7, 3))
    assert len(set(colors)) == 7
    assert all(0 <= channel <= 255 and isinstance(channel, int) for color in colors for channel in color)


def test_no_points_are_drawn_as_none(renderer: Renderer) -> None:
    assert track_colors(torch.zeros(0, 3)) == []
    _, images = render_tracks(renderer, CAMERA, torch.zeros(0, 3), 0.0, [0.0, 0.5])
    assert [image.shape for image in images] == [(50, 60, 3)] * 2


class Passage(Deformation):
    """All moves by 3 along y."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return positions - times[..., None] * positions.new_tensor([0.0, 3.0, 0.0])


def test_points_behind_the_camera_leave_no_trail() -> None:
    """One that comes from behind: where a projection would mirror it, nothing is drawn."""
    model = Renderer(DeformedField(Passage(), fog(0.0)), StratifiedSampler(4)).eval()
    camera = Camera(Intrinsics.from_angle(60, 50, 0.69), look_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    start = torch.tensor([[0.3, -1.0, 0.0]])
    _, images = render_tracks(model, camera, start, 0.0, [0.0, 0.25, 1.0], tolerance=10.0)
    drawn = list(images)[-1].float()
    plain = model.render_image(camera, 1.0).rgb
    changed = ((drawn / 255 - plain).abs().amax(-1) > 0.1).nonzero()
    assert len(changed)
    # It is 2 ahead and 0.3 to the right of the middle in the end, and that dot is all there is to see.
    column = 29.5 + 0.3 / 2 * camera.intrinsics.focal_x
    assert bool(((changed[:, 1] - column).abs() < 4).all())
