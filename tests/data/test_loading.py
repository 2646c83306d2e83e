"""Captures' frames to pixels: sizes, intrinsics, masks, missing images, videos, and pixels larger than memory."""

import subprocess
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from dnerf.core.cameras import Intrinsics
from dnerf.core.lenses import Distortion
from dnerf.data.capture import CaptureFrame, ImageFile
from dnerf.data.images import premultiplied_area_average
from dnerf.data.loading import final_intrinsics, load_frames
from dnerf.data.pixel_layout import empty_pixels
from dnerf.data.videos import read_frames, read_video_header, video_size

POSE = tuple(tuple(row) for row in torch.eye(4).tolist())


def random_pixels(seed: int, height: int = 6, width: int = 8, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def frame(
    path: Path, pixels: np.ndarray | None = None, *, lens: Intrinsics | None = None, **fields: object
) -> CaptureFrame:
    """A frame whose image, if pixels are given, is written as PNG."""
    if pixels is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(path)
        lens = lens or Intrinsics.from_angle(pixels.shape[1], pixels.shape[0], 0.7)
    return CaptureFrame(path.stem, POSE, lens or Intrinsics.from_angle(8, 6, 0.7), ImageFile(path), **fields)


def write_video(path: Path, frames: Iterable[np.ndarray], size: tuple[int, int], *options: str) -> Path:
    """Without loss."""
    writer = imageio_ffmpeg.write_frames(
        str(path), size, codec="png", pix_fmt_out="rgb24", macro_block_size=1, fps=10, output_params=list(options)
    )
    writer.send(None)
    for pixels in frames:
        writer.send(np.ascontiguousarray(pixels))
    writer.close()
    return path


@pytest.mark.parametrize("channels", [3, 4])
def test_images_of_one_size_are_read_as_they_are_and_reduced_to_a_width(tmp_path: Path, channels: int) -> None:
    pixels = [random_pixels(i, channels=channels) for i in range(3)]
    frames = [frame(tmp_path / f"{i}.png", each) for i, each in enumerate(pixels)]
    for resolution, (height, width) in ((None, (6, 8)), (8, (6, 8)), (5, (4, 5))):
        loaded = load_frames(frames, resolution=resolution)
        assert loaded.images.shape == (3, height, width, channels)
        for image, each in zip(loaded.images, pixels):
            np.testing.assert_array_equal(image, premultiplied_area_average(each, width, height))
        assert loaded.intrinsics == (Intrinsics.from_angle(8, 6, 0.7).resized(width, height),) * 3
        assert loaded.has_alpha == (channels == 4)
        assert loaded.notes == ()


def test_images_are_at_most_400_wide_unless_told(tmp_path: Path) -> None:
    frames = [frame(tmp_path / "a.png", random_pixels(0, 30, 500))]
    assert load_frames(frames).images.shape == (1, 24, 400, 3)
    assert load_frames(frames, resolution=500).images.shape == (1, 30, 500, 3)
    with pytest.raises(ValueError, match=r"resolution must be at most the images' width 500, or null .* got 501"):
        load_frames(frames, resolution=501)


def test_frames_of_different_sizes_are_each_read_and_reduced_as_alone(tmp_path: Path) -> None:
    sizes = [(6, 8), (8, 6), (6, 8), (3, 4)]
    frames = [frame(tmp_path / f"{i}.png", random_pixels(i, *size)) for i, size in enumerate(sizes)]
    loaded = load_frames(frames, resolution=6)
    alone = [load_frames([each], resolution=min(6, each.intrinsics.width)) for each in frames]
    assert [(i.height, i.width) for i in loaded.intrinsics] == [(4, 6), (8, 6), (4, 6), (3, 4)]
    expected = torch.cat([each.images.flatten(0, 2) for each in alone])
    assert torch.equal(loaded.images, expected)
    assert loaded.intrinsics == tuple(each.intrinsics[0] for each in alone)
    assert [final_intrinsics(each, 6) for each in frames] == list(loaded.intrinsics)


def test_intrinsics_of_the_full_size_are_scaled_to_reduced_images(tmp_path: Path) -> None:
    lens = Intrinsics(32, 24, 40.0, 44.0, 15.0, 13.0, distortion=Distortion("opencv", (-0.1,)))
    loaded = load_frames([frame(tmp_path / "a.png", random_pixels(0), lens=lens)])
    assert loaded.intrinsics == (lens.resized(8, 6),)
    assert len(loaded.notes) == 1
    assert "intrinsics of 32 x 24 are scaled to images of 8 x 6" in loaded.notes[0]
    # Reduced images have whole sizes: 33 x 25 by four are 8 x 6.
    lens = Intrinsics(33, 25, 40.0, 44.0)
    assert load_frames([frame(tmp_path / "a.png", lens=lens)]).intrinsics == (lens.resized(8, 6),)


@pytest.mark.parametrize("size", [(6, 8), (32, 8), (8, 24)])
def test_images_of_another_shape_than_their_intrinsics_are_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    frames = [frame(tmp_path / "a.png", random_pixels(0), lens=Intrinsics(*size, 20.0, 20.0))]
    with pytest.raises(ValueError, match=rf"a\.png: image must have the shape .* {size[0]} x {size[1]}, got 8 x 6"):
        load_frames(frames)


@pytest.mark.parametrize("is_upright", [True, False])
def test_images_are_turned_upright_unless_their_intrinsics_are_of_the_image_as_stored(
    tmp_path: Path, is_upright: bool
) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    stored = random_pixels(0, 6, 12)
    Image.fromarray(stored).save(tmp_path / "a.png", exif=exif)
    upright = np.rot90(stored, -1)
    size = (6, 12) if is_upright else (12, 6)
    loaded = load_frames([frame(tmp_path / "a.png", lens=Intrinsics(*size, 9.0, 9.0))])
    np.testing.assert_array_equal(loaded.images[0], upright if is_upright else stored)
    assert len(loaded.notes) == (0 if is_upright else 1)


def test_a_few_missing_images_are_left_out_and_named_and_more_are_refused(tmp_path: Path) -> None:
    frames = [frame(tmp_path / f"{i}.png", random_pixels(i)) for i in range(11)]
    (tmp_path / "3.png").unlink()
    loaded = load_frames(frames)
    assert [each.name for each in loaded.frames] == [str(i) for i in range(11) if i != 3]
    assert len(loaded.images) == 10
    assert loaded.notes == (f"1 of 11 images are missing, left out: {tmp_path / '3.png'}",)
    assert final_intrinsics(frames[3], 4) == frames[3].intrinsics.resized(4, 3)
    with pytest.raises(ValueError, match=r"3\.png: image does not exist, .* of 10: add them, or take their frames out"):
        load_frames(frames[:10])
    with pytest.raises(ValueError, match="frames must have images, 0 has none"):
        load_frames([replace(frames[0], image=None)])
    with pytest.raises(ValueError, match="frames must hold at least one"):
        load_frames([])


def test_masks_and_transparent_pixels_make_alpha_and_opaque_channels_none(tmp_path: Path) -> None:
    opaque = random_pixels(0, channels=4)
    opaque[..., 3] = 255
    one, other = frame(tmp_path / "a.png", opaque), frame(tmp_path / "b.png", random_pixels(1))
    assert not load_frames([one, other]).has_alpha
    assert load_frames([one, other], has_alpha=True).images[..., 3].eq(255).all()
    levels = random_pixels(2)[..., 0]
    Image.fromarray(levels).save(tmp_path / "mask.png")
    masked = replace(one, mask=tmp_path / "mask.png")
    loaded = load_frames([masked, other])
    np.testing.assert_array_equal(loaded.images[0, ..., 3], levels)
    assert loaded.images[1, ..., 3].eq(255).all()
    with pytest.raises(ValueError, match=r"mask\.png: image must be opaque, as the training images are"):
        load_frames([masked, other], has_alpha=False)
    opaque[0, 0, 3] = 254
    assert load_frames([frame(tmp_path / "a.png", opaque), other]).has_alpha
    with pytest.raises(ValueError, match=r"none\.png: image does not exist"):
        load_frames([replace(one, mask=tmp_path / "none.png")])


def test_ignored_pixels_are_those_that_a_mask_does_not_keep_whole_and_images_stay_opaque(tmp_path: Path) -> None:
    one, other = frame(tmp_path / "a.png", random_pixels(0)), frame(tmp_path / "b.png", random_pixels(1))
    levels = np.full((6, 8), 255, np.uint8)
    levels[1, 2], levels[5, 6] = 0, 254
    Image.fromarray(levels).save(tmp_path / "mask.png")
    masked = replace(one, mask=tmp_path / "mask.png")
    loaded = load_frames([masked, other], masks="ignored")
    assert not loaded.has_alpha
    assert torch.equal(loaded.images, load_frames([one, other]).images)
    assert loaded.is_known is not None
    assert (~loaded.is_known).nonzero().tolist() == [[8 * 1 + 2]]
    halved = load_frames([masked, other], resolution=4, masks="ignored").is_known
    assert halved is not None
    assert (~halved).nonzero().tolist() == [[1]]
    assert load_frames([one, other], masks="ignored").is_known is None
    Image.fromarray(0 * levels).save(tmp_path / "mask.png")
    with pytest.raises(ValueError, match=r"mask\.png: mask must leave a pixel of its image"):
        load_frames([masked, other], masks="ignored")


def test_frames_of_videos_are_theirs_in_any_order_beside_images(tmp_path: Path) -> None:
    pixels = [random_pixels(i, 16, 18) for i in range(7)]
    path = write_video(tmp_path / "a b.mkv", pixels, (18, 16))
    assert read_video_header(path) == (18, 16, 10.0, 7)
    assert video_size(path) == (18, 16)
    lens = Intrinsics(18, 16, 20.0, 20.0)
    one = [CaptureFrame(str(i), POSE, lens, ImageFile(path, i)) for i in (5, 0, 3, 3)]
    image = frame(tmp_path / "c.png", pixels[1], lens=lens)
    loaded = load_frames([one[0], image, *one[1:]])
    for found, i in zip(loaded.images, (5, 1, 0, 3, 3), strict=True):
        np.testing.assert_array_equal(found, pixels[i])
    reduced = load_frames(one, resolution=7)
    np.testing.assert_array_equal(reduced.images[0], premultiplied_area_average(pixels[5], 7, 6))
    with pytest.raises(ValueError, match=r"a b\.mkv: video must have the frame 7, counted from 0, got 7 frames"):
        load_frames([replace(one[0], image=ImageFile(path, 7))])


def test_frames_at_uneven_times_are_neither_doubled_nor_dropped(tmp_path: Path) -> None:
    pixels = [random_pixels(i, 16, 16) for i in range(5)]
    uneven = ("-vf", "setpts=N*N/10/TB", "-fps_mode", "vfr")
    path = write_video(tmp_path / "a.mkv", pixels, (16, 16), *uneven)
    np.testing.assert_array_equal(np.stack(list(read_frames(path))), np.stack(pixels))
    assert read_video_header(path).num_frames == 5


@pytest.mark.parametrize(
    "content",
    [b"", b"no video", b"#EXTM3U\n#EXTINF:1,\nhttp://localhost/a.ts\n", b"ffconcat version 1.0\nfile a.mkv\n"],
)
def test_what_is_no_video_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    write_video(tmp_path / "a.mkv", [random_pixels(0, 16, 16)], (16, 16))
    path = tmp_path / "b.mp4"
    path.write_bytes(content)
    for read in (read_video_header, video_size, lambda path: list(read_frames(path))):
        with pytest.raises(ValueError, match=r"b\.mp4: video cannot be decoded") as caught:
            read(path)
        assert "\n" not in str(caught.value)
        with pytest.raises(ValueError, match=r"c\.mp4: video does not exist"):
            read(tmp_path / "c.mp4")


def test_pixels_larger_than_memory_lie_in_a_file_that_is_gone_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    frames = [frame(tmp_path / f"{i}.png", random_pixels(i)) for i in range(3)]
    within, mapped = load_frames(frames), load_frames(frames, max_memory=100)
    assert torch.equal(mapped.images, within.images)
    assert mapped.images.is_contiguous()
    assert not list((tmp_path / "temporary").iterdir())
    names = [
        line.split(maxsplit=5)[5] for line in Path("/proc/self/maps").read_text().splitlines() if "dnerf-pix" in line
    ]
    assert len(names) == 1
    del mapped
    assert "dnerf-pix" not in Path("/proc/self/maps").read_text()


def test_a_full_disk_is_an_error_that_says_how_to_go_on() -> None:
    with pytest.raises(ValueError, match=r"the disk has no room .* TMPDIR .* or lower data\.resolution"):
        empty_pixels((2**50, 4))


SMALL = """
import resource, sys
import torch
from dnerf.core.cameras import Intrinsics
from dnerf.data.frames import Frames
from dnerf.data.pixel_layout import empty_pixels

num_frames, height, width = 100, 540, 960
images = empty_pixels((num_frames, height, width, 3), 2**20)
for i, image in enumerate(images):
    image.fill_(i)
frames = Frames(images, torch.eye(4).repeat(num_frames, 1, 1), torch.linspace(0, 1, num_frames),
                Intrinsics.from_angle(width, height, 0.7))
generator = torch.Generator().manual_seed(0)
for _ in range(50):
    indices = torch.randint(frames.num_pixels, (4096,), generator=generator)
    _, rgba = frames.pixels(indices)
    assert torch.equal(rgba[:, 0] * 255, (indices // (height * width)).float())
assert not frames.is_transparent
status = dict(line.split(":", 1) for line in open("/proc/self/status").read().splitlines())
print(int(status["RssAnon"].split()[0]), int(status["RssFile"].split()[0]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_mapped_pixels_take_no_memory_of_their_own() -> None:
    """148 MiB of pixels: were they in memory, it would be larger by them than with none."""
    runs = [
        subprocess.run(
            [sys.executable, "-c", SMALL.replace("540, 960", size)], capture_output=True, check=True, text=True
        )
        for size in ("540, 960", "2, 2")
    ]
    anonymous = [int(run.stdout.split()[0]) for run in runs]
    assert anonymous[0] - anonymous[1] < 20 * 1024  # KiB
