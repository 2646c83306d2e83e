"""Boxes that are far too large are noticed, and nothing that is seen and occupied is left out of the smaller one."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dnerf.backgrounds import ConstantBackground
from dnerf.box_check import BoxCheck, BoxTooLarge, check_views, reach, share_of_views, shows_outside
from dnerf.cameras import Camera, Intrinsics, look_at, orbit_path
from dnerf.compositing import FieldOutput
from dnerf.data.frames import Frames
from dnerf.fields import RadianceField
from dnerf.losses import PhotometricLoss
from dnerf.renderer import Renderer
from dnerf.samplers import OccupancySampler, StratifiedSampler
from dnerf.time_window import TimeWindow
from dnerf.training import Trainer, TrainingRecord


class Balls(RadianceField):
    """A ball of radius 0.3 and density 50 that moves along x over [-0.6, 0.6], and one at rest at `stray`."""

    def __init__(self, stray: tuple[float, float, float] | None = None) -> None:
        super().__init__()
        self.stray = stray
        self.weight = torch.nn.Parameter(torch.ones(()))

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        center = torch.stack([1.2 * times - 0.6, 0 * times, 0 * times], -1)
        inside = (positions - center).norm(dim=-1) < 0.3
        if self.stray is not None:
            inside = inside | ((positions - positions.new_tensor(self.stray)).norm(dim=-1) < 0.3)
        return 50.0 * inside * self.weight

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), torch.ones_like(positions) * 0.5)


def views(count: int = 12) -> Frames:
    """Views from a circle of radius 4 and height 2."""
    lens = Intrinsics.from_angle(8, 8, math.radians(40))
    poses = orbit_path(count, radius=math.sqrt(20), elevation=math.atan(0.5))
    return Frames(torch.zeros(count, 8, 8, 3, dtype=torch.uint8), poses, torch.linspace(0, 1, count), lens)


def renderer(half: float, field: RadianceField | None = None) -> Renderer:
    box = [[-half] * 3, [half] * 3]
    made = Renderer(
        field or Balls(), OccupancySampler(box, 0.05, 32, num_slabs=4, num_probes=4096), ConstantBackground("white")
    )
    made.sampler.fill(made.field)
    return made


def test_the_smaller_box_holds_matter_of_all_times_and_little_else() -> None:
    box = BoxCheck(room=0).smaller(renderer(4.0), views(), of_matter=True)
    assert box is not None
    ends = torch.tensor([[-0.9, -0.3, -0.3], [0.9, 0.3, 0.3]])
    cell = 0.25
    assert (box[0] <= ends[0]).all()
    assert (box[1] >= ends[1]).all()
    assert (box - ends).abs().max() <= 2 * cell  # matter may begin anywhere in its cell, and pictures widen it


def test_room_is_left_on_all_sides_but_not_beyond_the_box() -> None:
    model = renderer(4.0)
    tight, wide, all_of_it = (BoxCheck(room=room).smaller(model, views(), of_matter=True) for room in (0.0, 0.25, 10.0))
    assert tight is not None
    assert wide is not None
    assert all_of_it is not None
    side = float((tight[1] - tight[0]).max())
    torch.testing.assert_close(wide - tight, 0.25 * side * torch.tensor([[-1.0] * 3, [1.0] * 3]))
    torch.testing.assert_close(all_of_it, torch.tensor([[-4.0] * 3, [4.0] * 3]))


def test_a_box_that_fits_is_left_alone() -> None:
    assert BoxCheck().smaller(renderer(1.2), views(), of_matter=True) is None
    assert BoxCheck().smaller(renderer(1.2), views(), of_matter=False) is None


def test_matter_that_no_view_sees_counts_for_nothing() -> None:
    hidden = renderer(4.0, Balls(stray=(3.5, 3.5, -3.5)))
    assert BoxCheck(min_views=0.0).smaller(hidden, views(), of_matter=True) is None
    found = BoxCheck().smaller(hidden, views(), of_matter=True)
    torch.testing.assert_close(found, BoxCheck().smaller(renderer(4.0), views(), of_matter=True))


def test_matter_that_views_see_counts_wherever_it_is() -> None:
    found = BoxCheck(room=0).smaller(renderer(8.0, Balls(stray=(1.5, 1.5, 0.0))), views(), of_matter=True)
    assert found is not None
    assert (found[1, :2] >= 1.8).all()


def test_samplers_that_know_nothing_need_their_box() -> None:
    blind = Renderer(Balls(), StratifiedSampler(8, [[-4.0] * 3, [4.0] * 3]), ConstantBackground("white"))
    assert BoxCheck().smaller(blind, views(), of_matter=True) is None
    assert BoxCheck().smaller(blind, views(), of_matter=False) is None


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_the_share_of_views_is_that_of_rays_that_pass(seed: int) -> None:
    """A place on the ray of a view's pixel, between its planes, is seen by it; behind the planes it is not."""
    frames = views(1)
    generator = torch.Generator().manual_seed(seed)
    pixel = torch.randint(64, (1,), generator=generator)
    rays = frames.camera(0).rays(0.0, pixel)
    ends = torch.stack([rays.near, rays.far])
    inside = torch.lerp(ends[0], ends[1], torch.rand(1, generator=generator).clamp(0.001, 0.999))
    for distance, expected in ((inside, 1.0), (0.99 * ends[0], 0.0), (1.01 * ends[1], 0.0), (-inside, 0.0)):
        place = rays.origins + distance[:, None] * rays.directions
        assert share_of_views(frames, place).tolist() == [expected]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_every_place_that_a_view_shows_is_within_reach(seed: int) -> None:
    frames = views(5)
    low, high = reach(frames)
    generator = torch.Generator().manual_seed(seed)
    index = int(torch.randint(5, (), generator=generator))
    rays = frames.camera(index).rays(0.0)
    places = (
        rays.origins + torch.lerp(rays.near, rays.far, torch.rand(64, generator=generator))[:, None] * rays.directions
    )
    assert ((low - 1e-5 <= places) & (places <= high + 1e-5)).all()


def test_the_reach_ends_where_a_corner_of_a_picture_does() -> None:
    pose = look_at((4.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    lens = Intrinsics.from_angle(9, 9, 2 * math.atan(0.5))
    frames = Frames(torch.zeros(1, 9, 9, 3, dtype=torch.uint8), pose[None], torch.zeros(1), lens)
    across = 6 * 0.5 * 8 / 9  # from pixel centre to pixel centre at the far plane
    expected = torch.tensor([[-2.0, -across, -across], [2.0, across, across]])
    torch.testing.assert_close(reach(frames), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("half", [5.0, 100.0, 1e4])
def test_what_cameras_reach_is_enough_of_any_box(half: float) -> None:
    found = BoxCheck().smaller(renderer(half), views(), of_matter=False)
    torch.testing.assert_close(found, reach(views()))


def test_of_what_cameras_reach_that_is_enough_which_several_see() -> None:
    low, high = reach(views())
    half = float(torch.maximum(-low, high).max())
    model = renderer(half)
    all_of_it = BoxCheck(min_views=0).smaller(model, views(), of_matter=False)
    some = BoxCheck(min_views=0.4).smaller(model, views(), of_matter=False)
    assert all_of_it is None
    assert some is not None
    x = torch.linspace(-half, half, 100)
    line = torch.stack([x, 0 * x, 0 * x], -1)
    seen = x[share_of_views(views(), line) >= 0.4]
    cell = 2 * half / 32
    assert some[0, 0] <= seen.min() + 2 * cell
    assert some[1, 0] >= seen.max() - 2 * cell


def test_half_of_opposite_views_see_what_lies_behind_the_far_plane_of_the_other_half() -> None:
    poses = torch.stack([look_at((4.0, 0.0, 0.0), (0.0, 0.0, 0.0)), look_at((-4.0, 0.0, 0.0), (0.0, 0.0, 0.0))])
    frames = Frames(torch.zeros(2, 8, 8, 3, dtype=torch.uint8), poses, torch.zeros(2), Intrinsics.from_angle(8, 8, 0.7))
    places = torch.tensor([[0.0, 0.0, 0.0], [2.5, 0.0, 0.0], [0.0, 3.0, 0.0]])
    # 2.5 is 1.5 in front of the first camera, nearer than its near plane at 2, and 6.5 from the other.
    assert share_of_views(frames, places).tolist() == [1.0, 0.0, 0.0]
    assert share_of_views(frames, torch.tensor([[-1.99, 0.0, 0.0]])).tolist() == [1.0]
    assert Camera(frames.intrinsics, poses[0]).project(places[:1])[1].tolist() == pytest.approx([4.0])


def training(check: BoxCheck | None, **options: object) -> Trainer:
    return Trainer(
        **{"num_steps": 3, "num_rays": 16, "progress_bar": False, **options},
        losses={"rgb": PhotometricLoss()},
        box_check=check,
    )


def test_training_ends_before_its_first_step_when_views_do_not_reach_the_box() -> None:
    model = renderer(20.0)
    model.sampler.occupy(torch.ones(1, 1, 1, 1, dtype=torch.bool))
    with pytest.raises(BoxTooLarge, match="step 0") as found:
        training(BoxCheck()).fit(model, views(), seconds=2.5)
    assert found.value.seconds == 2.5
    torch.testing.assert_close(torch.tensor(found.value.box), reach(views()))


def test_training_ends_at_a_later_check_when_matter_is_found() -> None:
    model = renderer(2.9)
    model.sampler.occupy(torch.ones(1, 1, 1, 1, dtype=torch.bool))
    model.sampler.update_every = 2
    with pytest.raises(BoxTooLarge) as found:
        training(BoxCheck(every=2, until=2)).fit(model, views())
    assert found.value.step == 2
    assert found.value.seconds > 0


def test_training_goes_on_after_the_last_check() -> None:
    model = renderer(2.9)
    model.sampler.occupy(torch.ones(1, 1, 1, 1, dtype=torch.bool))
    model.sampler.update_every = 2
    assert training(BoxCheck(every=2, until=1)).fit(model, views()).step == 3


def with_opaque(index: int, row: int, column: int) -> Frames:
    """The views with alpha, all of it clear but for one pixel."""
    images = torch.zeros(12, 8, 8, 4, dtype=torch.uint8)
    images[index, row, column, 3] = 255
    return replace(views(), images=images)


def test_no_box_leaves_out_what_an_opaque_pixel_shows() -> None:
    """A body that the field has not found yet is seen all the same."""
    assert BoxCheck().smaller(renderer(4.0), with_opaque(7, 3, 3), of_matter=True) is not None
    assert BoxCheck().smaller(renderer(4.0), with_opaque(7, 0, 6), of_matter=True) is None
    assert BoxCheck().smaller(renderer(4.0), with_opaque(0, 6, 0), of_matter=True) is None


def test_an_opaque_pixel_looks_past_a_box_or_into_it() -> None:
    cube = torch.tensor([[-0.5] * 3, [0.5] * 3])
    assert not shows_outside(with_opaque(2, 3, 3), cube)
    assert shows_outside(with_opaque(2, 3, 3), cube + 3)
    behind = with_opaque(2, 3, 3).poses[2, :3, 3] * 3  # the box's other side of the camera
    assert shows_outside(with_opaque(2, 3, 3), cube + behind)
    beyond = replace(with_opaque(2, 3, 3), near=0.5, far=1.0)
    assert shows_outside(beyond, cube)
    assert not shows_outside(views(), cube + 3)  # no alpha


@pytest.mark.parametrize(
    ("box", "near", "far"), [(((10, 10, 10), (11, 11, 11)), 2.0, 6.0), (((-1, -1, -1), (1, 1, 1)), 7.0, 9.0)]
)
def test_a_box_that_no_camera_sees_is_refused(box: tuple, near: float, far: float) -> None:
    frames = replace(views(), near=near, far=far)
    with pytest.raises(ValueError, match=rf"box must be seen by some camera between near {near:g} and far {far:g}"):
        check_views(frames, torch.tensor(box, dtype=torch.float32))
    check_views(views(), torch.tensor([[-1.0] * 3, [1.0] * 3]))


def test_faces_that_cut_matter_are_named() -> None:
    """The ball goes from x = -0.9 to 0.9."""
    assert BoxCheck().cut(renderer(0.8), views()) == ["x=-0.8", "x=0.8"]
    assert BoxCheck().cut(renderer(1.1), views()) == []
    assert BoxCheck().cut(renderer(0.25), views()) == ["x=-0.25", "x=0.25", "y=-0.25", "y=0.25", "z=-0.25", "z=0.25"]


def test_junk_that_few_views_see_is_not_told_of() -> None:
    box = renderer(4.0, Balls(stray=(3.9, 0.0, 0.0)))
    assert BoxCheck(min_views=0.4).cut(box, views()) == []
    assert BoxCheck(min_views=0.0).cut(box, views()) == ["x=4"]


def test_training_ends_with_a_warning_where_matter_is_cut(caplog: pytest.LogCaptureFixture) -> None:
    training(BoxCheck(until=3)).fit(renderer(0.8), views())
    assert "matter reaches the box at x=-0.8, x=0.8" in caplog.text
    caplog.clear()
    training(None).fit(renderer(0.8), views())
    training(BoxCheck(until=3)).fit(renderer(1.1), views())
    training(BoxCheck(until=4)).fit(renderer(0.8), views())
    assert not caplog.text


@pytest.mark.parametrize(("spent", "goes_on"), [(0.0, False), (2000.0, False), (2600.0, True)])
def test_training_goes_on_when_too_little_time_is_left(spent: float, goes_on: bool) -> None:
    model = renderer(2.9)
    model.sampler.occupy(torch.ones(1, 1, 1, 1, dtype=torch.bool))
    model.sampler.update_every = 2
    trainer = training(BoxCheck(every=2, until_spent=0.25), max_seconds=10000.0)
    if goes_on:
        assert trainer.fit(model, views(), seconds=spent).step == 3
        return
    with pytest.raises(BoxTooLarge):
        trainer.fit(model, views(), seconds=spent)


@pytest.mark.parametrize("has_alpha", [True, False])
def test_without_alpha_the_check_waits_until_all_frames_are_in(has_alpha: bool) -> None:
    """Frames that are not in yet may show matter elsewhere; only pictures with alpha tell before they are."""
    model = renderer(2.9)
    model.sampler.occupy(torch.ones(1, 1, 1, 1, dtype=torch.bool))
    model.sampler.update_every = 2
    trainer = training(BoxCheck(every=2), num_steps=10, time_window=TimeWindow(end=0.8))
    with pytest.raises(BoxTooLarge, match="step 2:" if has_alpha else "step 8:"):
        trainer.fit(model, with_opaque(7, 3, 3) if has_alpha else views())


@pytest.mark.parametrize(("until", "is_found"), [(4, True), (1, False)])
def test_without_alpha_steps_of_the_check_count_from_when_all_frames_are_in(until: int, is_found: bool) -> None:
    """All are in from step 7.2 on, so step 9 is 1.8 steps after it, though far more than `until` from the first."""
    model = renderer(2.9)
    model.sampler.occupy(torch.ones(1, 1, 1, 1, dtype=torch.bool))
    model.sampler.update_every = 2
    trainer = training(BoxCheck(every=3, until=until), num_steps=12, time_window=TimeWindow(end=0.6))
    if not is_found:
        assert trainer.fit(model, views()).step == 12
        return
    with pytest.raises(BoxTooLarge, match="step 9:"):
        trainer.fit(model, views())


def test_what_cameras_reach_is_asked_for_whatever_time_is_left() -> None:
    model = renderer(20.0)
    with pytest.raises(BoxTooLarge, match="step 0"):
        training(BoxCheck(until_spent=0.0), max_seconds=1.0).fit(model, views(), seconds=0.9)


def test_schedules_begin_anew_with_the_training() -> None:
    """Half of the seconds were spent before: the first step has the full rate."""
    options = {"num_steps": 10**6, "max_seconds": 100.0, "log_every": 1, "final_learning_rate": 1e-4}
    factors = []

    class Stop(Exception):
        pass

    def stop(record: TrainingRecord, *_: object) -> None:
        factors.append(record.learning_rate_factor)
        raise Stop

    with pytest.raises(Stop):
        training(None, **options).fit(renderer(1.2), views(), seconds=50.0, callbacks=[stop])
    assert factors == [1.0]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"every": 0}, "every must be"),
        ({"until": 0}, "until must be"),
        ({"until_spent": -0.1}, "until_spent must be"),
        ({"until_spent": 1.1}, "until_spent must be in"),
        ({"shrink_below": 1.0}, "shrink_below must be in"),
        ({"shrink_below": "half"}, "shrink_below must be a number"),
        ({"min_views": 1.0}, "min_views must be in"),
        ({"room": -0.1}, "room must be"),
    ],
)
def test_numbers_out_of_range_are_named(options: dict[str, float], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        BoxCheck(**options)  # type: ignore[arg-type]
