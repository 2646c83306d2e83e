"""Pictures of tracks: trails lie where points were."""

import pytest
import torch
from reference import fog
from torch import Tensor

from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.deformations import Deformation
from dnerf.fields import DeformedField
from dnerf.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.tracks import draw_tracks, render_tracks, seen_points, track_colors

CAMERA = Camera(Intrinsics.from_angle(60, 50, 0.69), look_at((0.0, -3.5, 1.5)))


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    scene = make_scene("orbiting_balls")
    return Renderer(scene, StratifiedSampler(256, scene.box.tolist())).eval()


def test_a_trail_is_drawn_along_its_pixels_and_nowhere_else() -> None:
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


def test_hidden_points_are_left_out() -> None:
    image = torch.rand(20, 20, 3)
    pixels = torch.full((3, 1, 2), 10.0)
    without = draw_tracks(image, pixels[:, :0], torch.zeros(0, dtype=torch.bool), [])
    assert torch.equal(draw_tracks(image, pixels, torch.tensor([False]), [(255, 0, 0)]), without)
    assert not torch.equal(draw_tracks(image, pixels, torch.tensor([True]), [(255, 0, 0)]), without)


def test_seen_points_lie_on_matter(renderer: Renderer) -> None:
    points = seen_points(renderer, CAMERA, 0.0, 5)
    assert len(points) > 5
    inward = points + 0.02 * torch.nn.functional.normalize(points - CAMERA.pose[:3, 3], dim=-1)
    assert renderer.field.contains(inward, torch.zeros(len(points))).any(-1).all()


def test_tracks_are_those_of_the_scene(renderer: Renderer) -> None:
    points = seen_points(renderer, CAMERA, 0.0, 10)
    tracks, pictures = render_tracks(renderer, CAMERA, points, 0.0, [0.0, 0.1, 0.2])
    torch.testing.assert_close(tracks.positions[2], renderer.field.advect(points, 0.0, 0.2))
    frames = list(pictures)
    assert [frame.shape for frame in frames] == [(50, 60, 3)] * 3
    plain = renderer.render_image(CAMERA, 0.2).rgb
    changed = (frames[2].float() / 255 - plain).abs().amax(-1) > 0.3
    pixels = CAMERA.project(tracks.positions[2])[0].round().long()
    heads = changed[pixels[:, 1].clamp(0, 49), pixels[:, 0].clamp(0, 59)]
    assert heads.any()


def test_some_pictures_of_a_sequence_are_drawn_the_last_among_them(renderer: Renderer) -> None:
    points = seen_points(renderer, CAMERA, 0.0, 10)
    times = [0.0, 0.05, 0.1, 0.15, 0.2, 0.25]
    frames, some = (list(render_tracks(renderer, CAMERA, points, 0.0, times, every=n)[1]) for n in (1, 2))
    assert len(some) == 3
    assert all(torch.equal(one, other) for one, other in zip(some, frames[1::2]))


def test_no_matter_is_named(renderer: Renderer) -> None:
    away = Camera(CAMERA.intrinsics, look_at((0.0, -3.5, 1.5), (0.0, -7.0, 3.0)))
    with pytest.raises(ValueError, match="the picture shows no matter at a spacing of 5 pixels"):
        seen_points(renderer, away, 0.0, 5)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match="colors must be 2, one per point, got 1"):
        draw_tracks(torch.zeros(4, 4, 3), torch.zeros(1, 2, 2), torch.ones(2, dtype=torch.bool), [(0, 0, 0)])
    with pytest.raises(ValueError, match=r"visible must have shape \(2,\)"):
        draw_tracks(torch.zeros(4, 4, 3), torch.zeros(1, 2, 2), torch.ones(3, dtype=torch.bool), [(0, 0, 0)] * 2)


def test_colors_are_plain_bytes() -> None:
    colors = track_colors(torch.randn(7, 3))
    assert len(set(colors)) == 7
    assert all(0 <= channel <= 255 and isinstance(channel, int) for color in colors for channel in color)


def test_no_points_and_no_times_are_an_answer_and_an_error(renderer: Renderer) -> None:
    assert track_colors(torch.zeros(0, 3)) == []
    _, pictures = render_tracks(renderer, CAMERA, torch.zeros(0, 3), 0.0, [0.0, 0.5])
    assert [picture.shape for picture in pictures] == [(50, 60, 3)] * 2
    with pytest.raises(ValueError, match="pixels must be of one time at least, got none"):
        draw_tracks(torch.zeros(4, 4, 3), torch.zeros(0, 1, 2), torch.ones(1, dtype=torch.bool), [(0, 0, 0)])


def test_trails_have_gaps_where_places_are_unknown() -> None:
    places = torch.tensor([[5.0, 20], [20, 20], [torch.nan, torch.nan], [40, 20], [55, 20]])
    drawn = draw_tracks(torch.zeros(40, 60, 3), places[:, None], torch.tensor([True]), [(255, 0, 0)])
    red = drawn[20, :, 0].float()
    assert bool((red[7:18] > 200).all())
    assert bool((red[43:53] > 200).all())
    assert torch.count_nonzero(red[24:36]) == 0


class Passage(Deformation):
    """All moves by 3 along y."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return positions - times[..., None] * positions.new_tensor([0.0, 3.0, 0.0])


def test_points_behind_the_camera_leave_no_trail() -> None:
    """One that comes from behind: where a projection would mirror it, nothing is drawn."""
    model = Renderer(DeformedField(Passage(), fog(0.0)), StratifiedSampler(4)).eval()
    camera = Camera(Intrinsics.from_angle(60, 50, 0.69), look_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    start = torch.tensor([[0.3, -1.0, 0.0]])
    _, pictures = render_tracks(model, camera, start, 0.0, [0.0, 0.25, 1.0], tolerance=10.0)
    drawn = list(pictures)[-1].float()
    plain = model.render_image(camera, 1.0).rgb
    changed = ((drawn / 255 - plain).abs().amax(-1) > 0.1).nonzero()
    assert len(changed)
    # It is 2 ahead and 0.3 to the right of the middle in the end, and that dot is all there is to see.
    column = 29.5 + 0.3 / 2 * camera.intrinsics.focal_x
    assert bool(((changed[:, 1] - column).abs() < 4).all())
