import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from dnerf.core.cameras import Intrinsics, look_at
from dnerf.core.lenses import Distortion
from dnerf.data.frames import Frames, composite_on, is_rigid
from dnerf.data.pixel_layout import PixelLayout

INTRINSICS = Intrinsics(5, 4, 6.0, 7.0)


def make_frames(num_frames: int = 3, channels: int = 4, **changes: object) -> Frames:
    generator = torch.Generator().manual_seed(1)
    images = torch.randint(0, 256, (num_frames, 4, 5, channels), generator=generator, dtype=torch.uint8)
    if channels == 4:
        images[..., :3] = torch.minimum(images[..., :3], images[..., 3:])
    arguments: dict = {
        "images": images,
        "poses": torch.stack([look_at((3.0, i + 0.5, 2.0)) for i in range(num_frames)]),
        "times": torch.linspace(0, 1, num_frames),
        "intrinsics": INTRINSICS,
    }
    return Frames(**{**arguments, **changes})


def test_image_is_premultiplied_colour_plus_what_alpha_lets_through() -> None:
    frames = make_frames()
    background = (0.25, 0.5, 1.0)
    image = frames.image(1, background).double()
    raw = frames.images[1].double()
    for row, column, c in itertools.product(range(4), range(5), range(3)):
        see_through = 1 - raw[row, column, 3] / 255
        expected = raw[row, column, c] / 255 + see_through * background[c]
        assert abs(image[row, column, c] - expected) < 3e-7  # float32
    assert image.max() <= 1 + 1e-6


def test_pixels_that_do_not_count_are_replaced_by_others() -> None:
    known = torch.arange(60) % 3 != 1
    frames = make_frames(is_known=known)
    drawn = torch.randint(60, (200,), generator=torch.Generator().manual_seed(0))
    counted = frames.counted(drawn)
    assert bool(known[counted].all())
    assert torch.equal(counted[known[drawn]], drawn[known[drawn]])
    assert set(counted.tolist()) <= set(drawn.tolist())
    assert torch.equal(make_frames().counted(drawn), drawn)
    assert make_frames().known(0) is None
    for part, indices in ((frames, (0, 1, 2)), (frames.subset([2, 0]).to("cpu"), (2, 0))):
        for i, index in enumerate(indices):
            assert torch.equal(part.known(i), known[20 * index : 20 * index + 20].view(4, 5))
    for wrong in (known[:-1], torch.arange(60) < 40):
        with pytest.raises(ValueError, match="is_known must"):
            make_frames(is_known=wrong)


def test_composite_on_is_exact_where_alpha_is_zero_or_one_and_takes_a_background_per_pixel() -> None:
    rgba = torch.tensor([[0.0, 0, 0, 0], [0.2, 0.4, 0.6, 1]])
    out = composite_on(rgba, torch.tensor([1.0, 0.5, 0.0]))
    assert torch.equal(out, torch.tensor([[1.0, 0.5, 0.0], [0.2, 0.4, 0.6]]))
    many, backgrounds = torch.rand(7, 4), torch.rand(7, 3)
    each = torch.stack([composite_on(many[i], backgrounds[i]) for i in range(7)])
    assert torch.equal(composite_on(many, backgrounds), each)


@pytest.mark.parametrize(("rgba", "background"), [((2, 3), (3,)), ((2, 4), (4,)), ((), (3,))])
def test_composite_on_refuses_other_channels(rgba: tuple[int, ...], background: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="rgba and background must have shapes"):
        composite_on(torch.zeros(rgba), torch.zeros(background))


def test_opaque_frames_ignore_the_background_and_have_alpha_one() -> None:
    frames = make_frames(channels=3, background="white")
    assert torch.equal(frames.image(0, (0.0, 1.0, 0.0)), frames.images[0].float() / 255)
    assert torch.equal(frames.image(0), frames.images[0].float() / 255)
    rays, rgba = frames.pixels(torch.tensor([0, 59]))
    assert torch.equal(rgba[:, 3], torch.ones(2))
    assert torch.equal(rgba[1, :3], frames.images[2, 3, 4].float() / 255)
    assert len(rays) == 2


def test_what_lies_behind_images_with_alpha_is_not_guessed() -> None:
    with pytest.raises(ValueError, match=r"background must be three numbers .* for images with alpha, got"):
        make_frames().image(0)


@pytest.mark.parametrize("channels", [3, 4])
def test_frames_are_transparent_where_a_pixel_is_not_opaque(channels: int) -> None:
    frames = make_frames(channels=channels, images=torch.full((3, 4, 5, channels), 255, dtype=torch.uint8))
    assert not frames.is_transparent
    frames.images[1, 2, 3] = 254
    assert frames.is_transparent == (channels == 4)


@pytest.mark.parametrize("pixel_origin", ["center", "corner"])
def test_pixels_are_those_of_each_frames_camera(pixel_origin: str) -> None:
    frames = make_frames(intrinsics=Intrinsics(5, 4, 6.0, 7.0, 2.0, 2.5, pixel_origin), near=1.0, far=3.0)
    indices = torch.randperm(frames.num_pixels)
    rays, rgba = frames.pixels(indices)
    for position, index in enumerate(indices.tolist()):
        frame, inside = divmod(index, 20)
        whole = frames.camera(frame).rays(float(frames.times[frame]))
        for name in ("origins", "directions", "times", "near", "far"):
            found, expected = getattr(rays, name)[position], getattr(whole, name)[inside]
            torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)
        row, column = divmod(inside, 5)
        assert torch.equal(rgba[position], frames.images[frame, row, column].float() / 255)


LENSES = {
    "sizes": tuple(Intrinsics(width, height, 6.0, 7.0) for width, height in ((5, 4), (3, 7), (5, 4), (1, 1))),
    "focal lengths": tuple(Intrinsics(5, 4, 6.0 + i, 7.0, 2.5 - 0.3 * i) for i in range(4)),
    "lenses": (
        Intrinsics(5, 4, 6.0, 7.0, distortion=Distortion("opencv", (-0.2,), (0.01, 0.02))),
        Intrinsics(7, 3, 6.0, 7.0, distortion=Distortion("fisheye", (0.05,))),
        Intrinsics(5, 4, 6.0, 7.0),
        Intrinsics(5, 4, 6.0, 7.0, pixel_origin="corner", distortion=Distortion("opencv", (0.3,))),
    ),
    "one lens": (Intrinsics(5, 4, 6.0, 7.0, distortion=Distortion("opencv", (-0.2,))),) * 4,
}  # fmt: skip


def frames_of(intrinsics: tuple[Intrinsics, ...], channels: int = 4) -> tuple[Frames, list[Frames]]:
    """Frames, and each of them alone."""
    generator = torch.Generator().manual_seed(2)
    images = [
        torch.randint(0, 256, (1, lens.height, lens.width, channels), generator=generator, dtype=torch.uint8)
        for lens in intrinsics
    ]
    poses = torch.stack([look_at((3.0, i + 0.5, 2.0)) for i in range(len(images))])
    times, planes = torch.linspace(0, 1, len(images)), {"near": 1.0, "far": 3.0}
    alone = [
        Frames(image, poses[i, None], times[i, None], lens, **planes)
        for i, (image, lens) in enumerate(zip(images, intrinsics))
    ]
    is_shared = len({image.shape for image in images}) == 1
    together = torch.cat(images) if is_shared else torch.cat([image.flatten(0, 2) for image in images])
    return Frames(together, poses, times, intrinsics, **planes), alone


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("channels", [3, 4])
def test_frames_of_other_sizes_and_lenses_are_those_of_each_camera_alone(name: str, channels: int) -> None:
    frames, alone = frames_of(LENSES[name], channels)
    assert frames.num_pixels == sum(each.num_pixels for each in alone)
    assert (frames.shared_intrinsics is None) == (name != "one lens")
    assert frames.intrinsics == LENSES[name]
    order = torch.randperm(frames.num_pixels, generator=torch.Generator().manual_seed(0))
    rays, rgba = frames.pixels(order)
    places = torch.empty_like(order)
    places[order] = torch.arange(len(order))
    start = 0
    for i, each in enumerate(alone):
        assert torch.equal(frames.stored_image(i), each.images[0])
        assert torch.equal(frames.image(i, (0.1, 0.2, 0.3)), each.image(0, (0.1, 0.2, 0.3)))
        own_rays, own_rgba = each.pixels(torch.arange(each.num_pixels))
        chosen = places[start : start + each.num_pixels]
        assert torch.equal(rgba[chosen], own_rgba)
        for name in ("origins", "directions", "times", "near", "far"):
            # In float64 many lenses are undone by as many steps as the worst wants: one rounding apart at most.
            torch.testing.assert_close(getattr(rays, name)[chosen], getattr(own_rays, name), rtol=2e-7, atol=2e-7)
        start += each.num_pixels


def test_pixels_of_many_pinholes_have_the_bits_of_each() -> None:
    frames, alone = frames_of(LENSES["focal lengths"])
    rays, _ = frames.pixels(torch.arange(80))
    for name in ("origins", "directions", "times", "near", "far"):
        each = [getattr(own.pixels(torch.arange(20))[0], name) for own in alone]
        assert torch.equal(getattr(rays, name), torch.cat(each))


@pytest.mark.parametrize("name", LENSES)
def test_subsets_of_other_sizes_and_lenses_are_theirs(name: str) -> None:
    frames, alone = frames_of(LENSES[name])
    for rows in ([2, 0], [1], [-1, 1, 1]):
        part = frames.subset(rows)
        assert len(part) == len(rows)
        for i, row in enumerate(rows):
            assert torch.equal(part.stored_image(i), alone[row].images[0])
            assert part.intrinsics[i] == LENSES[name][row]
            assert torch.equal(part.poses[i], frames.poses[row])
    again = replace(frames, far=9.0).to("cpu")
    assert again.intrinsics == frames.intrinsics
    assert again.camera(1).far == 9.0
    assert torch.equal(again.images, frames.images)


def test_equal_intrinsics_are_stored_once() -> None:
    frames, _ = frames_of(tuple(Intrinsics(5, 4, 6.0 + i % 2, 7.0) for i in range(6)))
    assert len({id(lens) for lens in frames.intrinsics}) == 2
    assert make_frames().intrinsics == (INTRINSICS,) * 3


def test_every_number_of_a_pixel_is_its_frame_row_and_column_and_back() -> None:
    layout = PixelLayout([(2, 3), (1, 4), (3, 1)], torch.device("cpu"))
    expected = [(f, r, c) for f, (h, w) in enumerate(layout.sizes) for r in range(h) for c in range(w)]
    located = layout.locate(torch.arange(13))
    assert torch.stack(located, -1).tolist() == [list(each) for each in expected]
    assert layout.index(*located).tolist() == list(range(13))
    assert [side.tolist() for side in layout.sides(torch.tensor([2, 0]))] == [[3, 2], [1, 3]]


def test_pixels_of_no_index_are_no_rays_and_there_are_so_many() -> None:
    frames = make_frames()
    rays, rgba = frames.pixels(torch.empty(0, dtype=torch.int64))
    assert len(rays) == 0
    assert rgba.shape == (0, 4)
    assert (frames.num_pixels, len(frames)) == (60, 3)


@pytest.mark.parametrize(
    ("indices", "error"), [([60], IndexError), ([-1], IndexError), ([[0], [0]], ValueError), ([0.0, 0.0], ValueError)]
)
def test_pixels_beyond_the_last_and_other_than_a_row_of_int64_are_refused(indices: list, error: type) -> None:
    with pytest.raises(error, match="ind"):
        make_frames().pixels(torch.tensor(indices))


def test_subset_keeps_order_and_everything_else() -> None:
    frames = make_frames(names=("a", "b", "c"), near=0.5, far=9.0)
    part = frames.subset([2, 0, -1])
    for name in ("images", "poses", "times"):
        assert torch.equal(getattr(part, name), getattr(frames, name)[[2, 0, 2]])
    assert part.names == ("c", "a", "c")
    assert (part.near, part.far, part.shared_intrinsics) == (0.5, 9.0, INTRINSICS)


@pytest.mark.parametrize("indices", [[], [3], [0, -4]])
def test_subset_of_none_or_missing_frames_is_refused(indices: list[int]) -> None:
    with pytest.raises(ValueError, match="indices must name some of 3 frames"):
        make_frames().subset(indices)


@pytest.mark.gpu
def test_frames_move_to_the_gpu_and_give_the_same_pixels() -> None:
    frames, indices = make_frames(), torch.arange(60)
    rays, rgba = frames.pixels(indices)
    moved_rays, moved_rgba = frames.to("cuda").pixels(indices.cuda())
    assert moved_rgba.is_cuda
    torch.testing.assert_close(moved_rgba.cpu(), rgba)
    torch.testing.assert_close(moved_rays.directions.cpu(), rays.directions)


def bad_pose(**entries: float) -> Tensor:
    poses = make_frames().poses.clone()
    for place, value in entries.items():
        poses[1, int(place[1]), int(place[2])] = value
    return poses


@pytest.mark.parametrize(("changes", "message"), [
    ({"images": torch.zeros(3, 4, 6, 4, dtype=torch.uint8)}, "images must have shape"),
    ({"images": torch.zeros(3, 4, 5, 2, dtype=torch.uint8)}, "images must have shape"),
    ({"images": torch.zeros(0, 4, 5, 4, dtype=torch.uint8)}, "images must have shape"),
    ({"images": torch.zeros(3, 4, 5, 4)}, "images must be torch.uint8"),
    ({"images": torch.zeros(3, 4, 4, 5, dtype=torch.uint8).mT}, "images must be contiguous"),
    ({"poses": torch.eye(4)}, "poses must have shape"),
    ({"poses": torch.eye(4, dtype=torch.float64).expand(3, 4, 4)}, "poses must be torch.float32"),
    ({"poses": bad_pose(_00=math.nan)}, "pose 1 is not"),
    ({"poses": bad_pose(_03=math.inf)}, "pose 1 is not"),
    ({"times": torch.zeros(3, 1)}, "times must have shape"),
    ({"times": torch.tensor([0, 0.5, 1.001])}, "times must be in"),
    ({"times": torch.tensor([-0.001, 0.5, 1])}, "times must be in"),
    ({"times": torch.tensor([0, math.nan, 1])}, "times must be in"),
    ({"near": 6.0, "far": 2.0}, "near and far"),
    ({"background": "white"}, "background must be None"),
    ({"names": ("a",)}, "names must be 3"),
    ({"intrinsics": (INTRINSICS,) * 2}, "intrinsics must be one, or 3 as there are times, got 2"),
    ({"intrinsics": (INTRINSICS, INTRINSICS, Intrinsics(4, 4, 6.0, 7.0))}, r"images must have shape \(56, 3 or 4\)"),
    ({"channels": 3, "background": "pink"}, "color must be"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_frames(**changes)


def test_rotations_are_rigid_and_what_is_nearly_one_is_not() -> None:
    rotation = torch.eye(4, dtype=torch.float64)
    rotation[:3, :3] = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64)).Q
    rotation[:3, :3] *= torch.linalg.det(rotation[:3, :3])
    rotation[:3, 3] = torch.tensor([1e4, -2, 3])
    scaled, mirrored, sheared, projective, lost = (rotation.clone() for _ in range(5))
    scaled[:3, :3] *= 1.01
    mirrored[:3, 0] *= -1
    sheared[:3, 0] += 0.02 * sheared[:3, 1]
    projective[3, 2] = 0.1
    lost[0, 3] = np.inf
    expected = [True, False, False, False, False, False]
    assert is_rigid(torch.stack([rotation, scaled, mirrored, sheared, projective, lost])).tolist() == expected
