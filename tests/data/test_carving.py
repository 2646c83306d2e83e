"""Space carving with views of different sizes and lenses."""

import math
from dataclasses import replace

import torch

from dnerf.core.cameras import Intrinsics
from dnerf.core.lenses import Distortion
from dnerf.data import Frames, SyntheticData, render_frames
from dnerf.data.bounds import fit_box
from dnerf.data.carving import MAX_SUPPORT, Silhouettes
from dnerf.data.synthetic import random_views, render_exact
from dnerf.scenes import make_scene


def cropped(frames: Frames) -> Frames:
    """Every third frame as it is, every third without columns on the right, every third without rows below."""
    images, lenses = [], []
    for i, lens in enumerate(frames.intrinsics):
        height, width = lens.height - (7 if i % 3 == 2 else 0), lens.width - (5 if i % 3 == 1 else 0)
        images.append(frames.stored_image(i)[:height, :width].flatten(0, 1))
        center_x, center_y = lens.center
        lenses.append(replace(lens, width=width, height=height, center_x=center_x, center_y=center_y))
    return replace(frames, images=torch.cat(images), intrinsics=tuple(lenses))


def test_support_among_views_of_different_sizes_is_the_number_of_those_that_are_opaque_there() -> None:
    frames = cropped(SyntheticData(make_scene("orbiting_balls"), 24, num_train=9).frames("train"))
    silhouettes = Silhouettes.of(frames)
    index, rays = silhouettes.outlines()
    distances = torch.lerp(rays.near[:, None], rays.far[:, None], torch.rand(len(rays), 5))
    motion = 0.05
    found = silhouettes.support(index, rays, distances, motion)

    def is_opaque(view: int, own: int, position: torch.Tensor) -> bool:
        pixel, depth = frames.camera(view).project(position)
        column, row = (pixel + 0.5).floor().int().tolist()
        height, width = frames.layout.sizes[view]
        if not (2 <= depth <= 6 and 0 <= column < width and 0 <= row < height):
            return False
        reach = int(1 + motion * 24 * abs(view - own))
        image = frames.stored_image(view)[..., 3]
        window = image[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
        return bool((window >= 26).any())

    for ray in range(0, len(rays), 5):
        for step in range(5):
            own = int(index[ray])
            position = rays.origins[ray] + distances[ray, step] * rays.directions[ray]
            expected = 1
            for side in (-1, 1):
                view = own + side
                while 0 <= view < 9 and is_opaque(view, own, position):
                    expected, view = expected + 1, view + side
            assert int(found[ray, step]) == min(expected, MAX_SUPPORT)


def test_boxes_fitted_to_views_through_a_lens_or_of_different_sizes_are_nearly_those_of_pinholes() -> None:
    scene = make_scene("static")
    poses, times = random_views(24)
    pinholes = render_frames(scene, poses, times, 48)
    lens = Intrinsics.from_angle(48, 48, math.radians(44))
    lenses = tuple(
        replace(lens, distortion=Distortion("opencv", (-0.3,)) if i % 2 else Distortion("fisheye")) for i in range(24)
    )
    bent = replace(pinholes, intrinsics=lenses)
    images = torch.empty_like(pinholes.images)
    for i, time in enumerate(times.tolist()):
        rgb, opacity, _ = render_exact(scene, bent.camera(i).rays(time))
        images[i] = (torch.cat([rgb, opacity[:, None]], -1) * 255).round().to(torch.uint8).view(48, 48, 4)
    coarse = render_frames(scene, poses, times, 36)
    each = [(coarse if i % 2 else pinholes) for i in range(24)]
    pixels = torch.cat([frames.stored_image(i).flatten(0, 1) for i, frames in enumerate(each)])
    mixed = replace(pinholes, images=pixels, intrinsics=tuple(frames.intrinsics[0] for frames in each))
    expected = fit_box(pinholes)
    side = float((expected[1] - expected[0]).max())
    for frames in (replace(bent, images=images), mixed):
        # A block is one pixel of the finer ones: 3 % of the box at distance 4.
        assert float((fit_box(frames) - expected).abs().max()) < 0.06 * side
