"""The map of where pictures are wrong, and the pixels drawn there."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dnerf.cameras import Intrinsics
from dnerf.data.frames import Frames
from dnerf.error_map import LEAST, UNSEEN, ErrorMap


def frames(count: int = 3, height: int = 6, width: int = 8) -> Frames:
    images = torch.zeros(count, height, width, 4, dtype=torch.uint8)
    intrinsics = Intrinsics(width, height, 10.0, 10.0)
    return Frames(images, torch.eye(4).repeat(count, 1, 1), torch.linspace(0, 1, count), intrinsics)


def begun(pictures: Frames, **settings: float) -> ErrorMap:
    error_map = ErrorMap(**settings)
    error_map.begin(pictures)
    return error_map


def guided(error_map: ErrorMap, count: int, frames_in: list[int] | None = None) -> Tensor:
    chosen = None if frames_in is None else torch.tensor(frames_in)
    evenly = torch.zeros(count, dtype=torch.int64)
    return error_map.guide(evenly, chosen, generator=torch.Generator().manual_seed(0))


def shares(indices: Tensor, pictures: Frames) -> Tensor:
    return torch.bincount(indices, minlength=pictures.num_pixels) / len(indices)


def test_pixels_are_drawn_in_proportion_to_the_error_of_their_block() -> None:
    pictures = frames(2, 4, 4)
    error_map = begun(pictures, share=1.0, resolution=2)  # blocks of 2 x 2
    error_map.errors.copy_(torch.tensor([[[0.1, 0.0], [0.0, 0.3]], [[0.0, 0.0], [0.2, 0.0]]]))
    drawn = shares(guided(error_map, 60000), pictures).view(2, 4, 4)
    expected = (error_map.errors / 0.6 / 4).repeat_interleave(2, 1).repeat_interleave(2, 2)
    assert torch.all(drawn[expected == 0] == 0)
    # Five standard deviations of a count among 60,000.
    assert (drawn - expected).abs().max() < 5 * (0.125 / 60000) ** 0.5


def test_pixels_of_a_cut_block_are_drawn_evenly() -> None:
    pictures = frames(1, 5, 7)  # blocks of 4 x 4, cut to 1 and 3
    error_map = begun(pictures, share=1.0, resolution=2)
    error_map.errors.copy_(torch.tensor([[[0.0, 0.0], [0.0, 0.5]]]))
    drawn = shares(guided(error_map, 30000), pictures).view(5, 7)
    assert drawn[4, 4:] == pytest.approx([1 / 3] * 3, abs=5 * (2 / 9 / 30000) ** 0.5)
    assert drawn[4, 4:].sum() == pytest.approx(1)


def test_the_first_rays_stay_where_they_were_drawn() -> None:
    pictures = frames()
    evenly = torch.arange(9)
    for share, kept in ((0.0, 9), (0.5, 5), (1.0, 0)):
        drawn = begun(pictures, share=share).guide(evenly, None, generator=torch.Generator().manual_seed(0))
        assert drawn.shape == evenly.shape
        assert torch.equal(drawn[:kept], evenly[:kept])


def test_only_frames_that_are_in_are_drawn() -> None:
    pictures = frames(5)
    drawn = guided(begun(pictures, share=1.0), 500, [4, 1])
    assert set((drawn // (pictures.num_pixels // 5)).tolist()) == {1, 4}


def test_what_is_right_everywhere_is_drawn_evenly() -> None:
    pictures = frames(1, 2, 2)
    error_map = begun(pictures, share=1.0)
    error_map.learn(torch.arange(4), torch.zeros(4))
    assert torch.equal(error_map.errors, torch.full((1, 2, 2), LEAST))
    assert shares(guided(error_map, 4000), pictures) == pytest.approx([0.25] * 4, abs=0.04)


def test_blocks_know_the_mean_error_of_late() -> None:
    pictures = frames(2, 6, 8)
    error_map = begun(pictures, resolution=4, memory=0.75)  # blocks of 2 x 2
    generator = torch.Generator().manual_seed(1)
    known: dict[tuple[int, int, int], float] = {}
    for _ in range(4):
        indices = torch.randint(pictures.num_pixels, (30,), generator=generator)
        errors = torch.rand(30, generator=generator)
        error_map.learn(indices, errors)
        found: dict[tuple[int, int, int], list[float]] = {}
        for index, error in zip(indices.tolist(), errors.tolist()):
            frame, row, column = index // 48, index % 48 // 8, index % 8
            found.setdefault((frame, row // 2, column // 2), []).append(error)
        for block, several in found.items():
            mean = sum(several) / len(several)
            known[block] = 0.75 * known[block] + 0.25 * mean if block in known else mean
    expected = torch.full((2, 3, 4), UNSEEN)
    for block, error in known.items():
        expected[block] = error
    torch.testing.assert_close(error_map.errors, expected, rtol=0, atol=1e-6)  # rounding of float32


@pytest.mark.parametrize("error", [float("nan"), float("inf"), 7.0])
def test_an_error_that_is_none_counts_as_never_seen(error: float) -> None:
    pictures = frames(1, 2, 2)
    error_map = begun(pictures)
    error_map.learn(torch.tensor([1]), torch.tensor([error]))
    assert torch.equal(error_map.errors, torch.full((1, 2, 2), UNSEEN))
    error_map.learn(torch.tensor([1]), torch.tensor([0.25]))
    assert error_map.errors[0, 0, 1] == 0.25


@pytest.mark.parametrize("error", [1.0, 0.9999999])
def test_what_is_as_wrong_as_can_be_has_been_seen(error: float) -> None:
    error_map = begun(frames(1, 2, 2))
    error_map.learn(torch.tensor([1]), torch.tensor([error]))
    assert error < error_map.errors[0, 0, 1] + 1e-5
    assert error_map.errors[0, 0, 1] < UNSEEN


def test_rays_without_places_change_nothing() -> None:
    pictures = frames(1, 4, 4)
    error_map = begun(pictures, resolution=2, memory=0.5)
    error_map.learn(torch.tensor([0, 2]), torch.tensor([0.5, 0.25]))
    before = error_map.errors.clone()
    error_map.learn(torch.tensor([0, 1, 2, 3, 15]), torch.tensor([-1.0, 0.1, -1.0, -1.0, -1.0]))
    expected = before.clone()
    expected[0, 0, 0] = 0.3  # of 0.5 and 0.1; the others as they were, the last one unseen
    torch.testing.assert_close(error_map.errors, expected)
    assert error_map.errors[0, 1, 1] == UNSEEN


@given(
    size=st.tuples(st.integers(1, 4), st.integers(1, 23), st.integers(1, 23)),
    resolution=st.integers(1, 30),
    count=st.integers(0, 40),
)
def test_pixels_of_any_frames_exist_and_fall_into_their_blocks(
    size: tuple[int, int, int], resolution: int, count: int
) -> None:
    pictures = frames(*size)
    error_map = begun(pictures, share=1.0, resolution=resolution)
    assert max(error_map.errors.shape[1:]) <= resolution
    drawn = guided(error_map, count)
    assert torch.all((drawn >= 0) & (drawn < pictures.num_pixels))
    error_map.learn(drawn, torch.zeros(count))
    assert int((error_map.errors < UNSEEN).sum()) <= count
    everything = torch.arange(pictures.num_pixels)
    error_map.learn(everything, torch.zeros(len(everything)))
    assert torch.all(error_map.errors < UNSEEN)


@pytest.mark.parametrize(
    "settings", [{"share": -0.1}, {"share": 1.1}, {"resolution": 0}, {"memory": 1.0}, {"memory": -0.1}]
)
def test_numbers_out_of_range_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(settings))):
        ErrorMap(**settings)
