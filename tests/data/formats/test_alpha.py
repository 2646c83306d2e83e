"""Whether images have alpha is decided by their pixels, not by what their headers say."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dnerf.data.formats.legacy import has_transparency, load_blender

Scene = Callable[..., Path]


def straight_pixels(root: Path, index: int) -> np.ndarray:
    return np.asarray(Image.open(root / "train" / f"r_{index}.png"))


def test_images_without_alpha_become_opaque_frames(make_scene: Scene) -> None:
    root = make_scene(lambda m: m.update(background=[0, 0.5, 1]), mode="RGB")
    frames = load_blender(root, "train")
    assert not frames.has_alpha
    np.testing.assert_array_equal(frames.images[2].numpy(), straight_pixels(root, 2))
    assert frames.background == (0, 0.5, 1)


def test_one_image_with_alpha_gives_all_alpha(make_scene: Scene) -> None:
    root = make_scene(lambda m: m.update(background=[1, 1, 1]))
    image = Image.open(root / "train" / "r_0.png").convert("RGB")
    image.save(root / "train" / "r_0.png")
    frames = load_blender(root, "train")
    assert (frames.images[0, ..., 3] == 255).all()
    np.testing.assert_array_equal(frames.images[0, ..., :3].numpy(), np.asarray(image))
    assert frames.background is None


def opaque(root: Path) -> Path:
    """Alpha 255 everywhere, as the header does not say."""
    for path in (root / "train").glob("*.png"):
        image = Image.open(path)
        image.putalpha(255)
        image.save(path)
    return root


@pytest.mark.parametrize("resolution", [None, 4])
def test_alpha_that_is_opaque_everywhere_is_none(make_scene: Scene, resolution: int | None) -> None:
    root = opaque(make_scene(lambda m: m.update(background=[0, 0, 0])))
    frames = load_blender(root, "train", resolution)
    assert not has_transparency(root)
    assert not frames.has_alpha
    assert frames.background == (0, 0, 0)
    if resolution is None:
        np.testing.assert_array_equal(frames.images[1].numpy(), straight_pixels(root, 1)[..., :3])
    assert load_blender(root, "train", has_alpha=True).images[..., 3].eq(255).all()


def test_one_transparent_pixel_is_enough_for_alpha_and_refused_where_there_is_none(make_scene: Scene) -> None:
    root = opaque(make_scene())
    pixels = straight_pixels(root, 2).copy()
    pixels[5, 7, 3] = 254
    Image.fromarray(pixels).save(root / "train" / "r_2.png")
    assert has_transparency(root)
    assert load_blender(root, "train").has_alpha
    with pytest.raises(ValueError, match=r"train/r_2.png: image must be opaque, as the training images are, got trans"):
        load_blender(root, "train", has_alpha=False)
