"""Which pixels a step learns from: all alike, of the frames that are in, and where images are wrong."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dnerf.core.cameras import Intrinsics
from dnerf.data import Frames
from dnerf.data.pixel_samplers import LEAST, UNKNOWN, ErrorGuidedPixels, PixelSampler, TemporalCurriculum, UniformPixels

SAMPLERS = {
    "uniform": UniformPixels,
    "curriculum": lambda: TemporalCurriculum(0.5, 0.3),
    "guided": lambda: ErrorGuidedPixels(UniformPixels(), 0.5, resolution=4),
    "guided curriculum": lambda: ErrorGuidedPixels(TemporalCurriculum(0.5, 0.3), 1.0, resolution=3),
}


def frames(count: int = 3, height: int = 6, width: int = 8, times: list[float] | None = None) -> Frames:
    images = torch.zeros(count, height, width, 4, dtype=torch.uint8)
    chosen = torch.linspace(0, 1, count) if times is None else torch.tensor(times)
    return Frames(images, torch.eye(4).repeat(count, 1, 1), chosen, Intrinsics(width, height, 10.0, 10.0))


def draw(pixels: PixelSampler, count: int, progress: float = 0.0, seed: int = 0) -> Tensor:
    return pixels.draw(count, progress, torch.Generator().manual_seed(seed))


def guided(images: Frames, share: float = 1.0, **settings: float) -> ErrorGuidedPixels:
    made = ErrorGuidedPixels(UniformPixels(), share, **settings)
    made.begin(images)
    return made


@pytest.mark.parametrize("name", SAMPLERS)
@given(st.tuples(st.integers(1, 5), st.integers(1, 23), st.integers(1, 23)), st.integers(0, 40), st.floats(0, 1))
def test_any_sampler_draws_pixels_that_there_are_and_of_frames_that_are_in(
    name: str, size: tuple[int, int, int], count: int, progress: float
) -> None:
    images, pixels, again = frames(*size), SAMPLERS[name](), SAMPLERS[name]()
    for sampler in (pixels, again):
        sampler.begin(images)
    inner = pixels.pixels if isinstance(pixels, ErrorGuidedPixels) else pixels
    chosen = inner.frames_in(progress) if isinstance(inner, TemporalCurriculum) else None
    for seed in (0, 1):
        drawn = draw(pixels, count, progress, seed)
        assert drawn.shape == (count,)
        assert drawn.dtype == torch.int64
        assert torch.all((drawn >= 0) & (drawn < images.num_pixels))
        assert chosen is None or {*(drawn // (size[1] * size[2])).tolist()} <= {*chosen.tolist()}
        assert torch.equal(drawn, draw(again, count, progress, seed))
        again.load_state_dict(pixels.state_dict())
        for sampler in (pixels, again):  # what was learnt comes back with its state, or has the same effect
            sampler.feedback(drawn, torch.linspace(-0.1, 1.1, count))
    assert torch.equal(draw(pixels, count, progress), draw(again, count, progress))
    pixels.begin(frames(2))  # it serves other frames, too
    assert torch.all(draw(pixels, 30) < frames(2).num_pixels)


def uneven_frames() -> Frames:
    """Frames of 4 x 5, 9 x 2, 1 x 1 and 3 x 8 pixels."""
    lenses = [Intrinsics(width, height, 10.0, 10.0) for height, width in ((4, 5), (9, 2), (1, 1), (3, 8))]
    images = torch.zeros(20 + 18 + 1 + 24, 4, dtype=torch.uint8)
    return Frames(images, torch.eye(4).repeat(4, 1, 1), torch.linspace(0, 1, 4), lenses)


@pytest.mark.parametrize("name", SAMPLERS)
@pytest.mark.parametrize("progress", [0.0, 0.2, 1.0])
def test_all_pixels_of_frames_of_different_sizes_are_drawn_alike(name: str, progress: float) -> None:
    images, pixels = uneven_frames(), SAMPLERS[name]()
    pixels.begin(images)
    inner = pixels.pixels if isinstance(pixels, ErrorGuidedPixels) else pixels
    chosen = inner.frames_in(progress) if isinstance(inner, TemporalCurriculum) else None
    frames_in = set(range(4)) if chosen is None else set(chosen.tolist())
    starts = images.layout.starts
    expected = {p for i in frames_in for p in range(starts[i], starts[i + 1])}
    drawn = draw(pixels, 6000, progress)
    assert set(drawn.tolist()) == expected
    if name in ("uniform", "curriculum"):
        # Five standard deviations of a count.
        counts = torch.bincount(drawn, minlength=63)[sorted(expected)] / 6000
        assert (counts - 1 / len(expected)).abs().max() < 5 * (1 / len(expected) / 6000) ** 0.5


def test_errors_are_known_of_blocks_of_frames_of_different_sizes() -> None:
    images = uneven_frames()
    pixels = guided(images, resolution=3)  # blocks of 3 x 3
    assert pixels.errors.shape == (4, 3, 3)
    inside = [(2, 2), (3, 1), (1, 1), (1, 3)]
    expected = torch.zeros(4, 3, 3)
    for i, (rows, columns) in enumerate(inside):
        expected[i, :rows, :columns] = UNKNOWN
    assert torch.equal(pixels.errors, expected)
    # Row 7, column 1 of the second frame, and row 0, column 7 of the last.
    pixels.feedback(torch.tensor([20 + 15, 39 + 7]), torch.tensor([0.25, 0.5]))
    expected[1, 2, 0], expected[3, 0, 2] = 0.25, 0.5
    assert torch.equal(pixels.errors, expected)


def seen(window: TemporalCurriculum, times: list[float], progress: float) -> set[float]:
    window.begin(frames(len(times), times=times))
    return {times[i] for i in (draw(window, 2000, progress) // 48).tolist()}


def test_frames_come_in_from_the_origin_outwards_those_of_one_time_together() -> None:
    times = [0.9, 0.1, 0.5, 0.3, 0.7]
    window = TemporalCurriculum(0.5, 0.4, origin=0.4)
    assert seen(window, times, 0.0) == {0.5, 0.3}
    # Half way there, 0.7 of five frames: 3.5 rounds to the even 4; 0.1 and 0.7 are next.
    assert seen(window, times, 0.25) == {0.5, 0.3, 0.1, 0.7}
    assert seen(window, times, 0.5) == {*times}
    assert window.frames_in(0.5) is None
    assert seen(TemporalCurriculum(start=0.01, origin=0.2), [0.0, 1.0], 0.0) == {0.0}  # one at least
    together = TemporalCurriculum(start=0.1)
    assert seen(together, [0.3] * 10, 0.0) == {0.3}
    assert together.frames_in(0.0) is None
    assert len(set((draw(together, 2000) // 48).tolist())) == 10
    assert seen(TemporalCurriculum(start=0.4), [0.0, 0.4, 0.5, 0.6, 1.0], 0.0) == {0.4, 0.5, 0.6}


def test_all_pixels_of_the_frames_that_are_in_are_drawn() -> None:
    window = TemporalCurriculum(0.6, 0.5, origin=1.0)
    window.begin(frames(2))
    assert set(draw(window, 2000).tolist()) == set(range(48, 96))
    even = UniformPixels()
    even.begin(frames(2))
    assert torch.equal(draw(window, 50, 0.6), draw(even, 50))  # with all in, nothing is left of it


def shares(indices: Tensor, images: Frames) -> Tensor:
    return torch.bincount(indices, minlength=images.num_pixels) / len(indices)


def test_pixels_are_drawn_in_proportion_to_the_error_of_their_block() -> None:
    images = frames(2, 4, 4)
    pixels = guided(images, resolution=2)  # blocks of 2 x 2
    pixels.errors.copy_(torch.tensor([[[0.1, 0.0], [0.0, 0.3]], [[0.0, 0.0], [0.2, 0.0]]]))
    drawn = shares(draw(pixels, 60000), images).view(2, 4, 4)
    expected = (pixels.errors / 0.6 / 4).repeat_interleave(2, 1).repeat_interleave(2, 2)
    assert torch.all(drawn[expected == 0] == 0)
    # Five standard deviations of a count among 60,000.
    assert (drawn - expected).abs().max() < 5 * (0.125 / 60000) ** 0.5


def test_pixels_of_a_cut_block_and_what_is_right_everywhere_are_drawn_evenly() -> None:
    images = frames(1, 5, 7)  # blocks of 4 x 4, cut to 1 and 3
    pixels = guided(images, resolution=2)
    pixels.errors.copy_(torch.tensor([[[0.0, 0.0], [0.0, 0.5]]]))
    drawn = shares(draw(pixels, 30000), images).view(5, 7)
    assert drawn[4, 4:] == pytest.approx([1 / 3] * 3, abs=5 * (2 / 9 / 30000) ** 0.5)
    pixels = guided(frames(1, 2, 2))
    pixels.feedback(torch.arange(4), torch.zeros(4))
    assert torch.equal(pixels.errors, torch.full((1, 2, 2), LEAST))
    assert shares(draw(pixels, 4000), frames(1, 2, 2)) == pytest.approx([0.25] * 4, abs=0.04)


def test_the_first_pixels_are_those_of_the_sampler_it_wraps() -> None:
    even = UniformPixels()
    even.begin(frames())
    for share, kept in ((0.0, 9), (0.5, 5), (1.0, 0)):
        assert torch.equal(draw(guided(frames(), share), 9)[:kept], draw(even, 9)[:kept])


def test_blocks_know_the_mean_error_of_late() -> None:
    images = frames(2)
    pixels = guided(images, resolution=4, memory=0.75)  # blocks of 2 x 2
    generator = torch.Generator().manual_seed(1)
    known: dict[tuple[int, int, int], float] = {}
    for _ in range(4):
        indices = torch.randint(images.num_pixels, (30,), generator=generator)
        errors = torch.rand(30, generator=generator)
        pixels.feedback(indices, errors)
        found: dict[tuple[int, int, int], list[float]] = {}
        for index, error in zip(indices.tolist(), errors.tolist()):
            found.setdefault((index // 48, index % 48 // 8 // 2, index % 8 // 2), []).append(error)
        for block, several in found.items():
            mean = sum(several) / len(several)
            known[block] = 0.75 * known[block] + 0.25 * mean if block in known else mean
    expected = torch.full((2, 3, 4), UNKNOWN)
    for block, error in known.items():
        expected[block] = error
    torch.testing.assert_close(pixels.errors, expected, rtol=0, atol=1e-6)  # rounding of float32


@pytest.mark.parametrize("error", [float("nan"), float("inf"), 7.0])
def test_an_error_that_is_none_counts_as_unknown(error: float) -> None:
    pixels = guided(frames(1, 2, 2))
    pixels.feedback(torch.tensor([1]), torch.tensor([error]))
    assert torch.equal(pixels.errors, torch.full((1, 2, 2), UNKNOWN))
    pixels.feedback(torch.tensor([1]), torch.tensor([0.25]))
    assert pixels.errors[0, 0, 1] == 0.25
    pixels.feedback(torch.tensor([1]), torch.tensor([1.0]))  # as wrong as can be, and known
    assert 0.6 < pixels.errors[0, 0, 1] < UNKNOWN


def test_rays_that_were_not_rendered_change_nothing() -> None:
    pixels = guided(frames(1, 4, 4), resolution=2, memory=0.5)
    pixels.feedback(torch.tensor([0, 2]), torch.tensor([0.5, 0.25]))
    expected = pixels.errors.clone()
    pixels.feedback(torch.tensor([0, 1, 2, 3, 15]), torch.tensor([-1.0, 0.1, -1.0, -1.0, -1.0]))
    expected[0, 0, 0] = 0.3  # of 0.5 and 0.1; the others as they were, the last one unknown
    torch.testing.assert_close(pixels.errors, expected)
    assert pixels.errors[0, 1, 1] == UNKNOWN


@pytest.mark.parametrize(("make", "message"), [
    (lambda: TemporalCurriculum(origin=1.5), r"origin must be in \[0, 1\], got 1.5"),
    (lambda: TemporalCurriculum(0.0), "end must be > 0"),
    (lambda: TemporalCurriculum(start=2.0), r"start must be in \(0, 1\], got 2.0"),
    (lambda: guided(frames(), -0.1), r"share must be in \[0, 1\], got -0.1"),
    (lambda: guided(frames(), resolution=0), "resolution must be > 0"),
    (lambda: guided(frames(), memory=1.0), r"memory must be in \[0, 1\), got 1.0"),
])  # fmt: skip
def test_numbers_out_of_range_are_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
