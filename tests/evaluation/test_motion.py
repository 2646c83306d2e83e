import math
from collections.abc import Callable

import pytest
import torch

from dnerf.evaluation import end_point_error, flow_outliers, track_errors


def test_end_point_error_is_the_mean_length() -> None:
    truth = torch.zeros(2, 2, 2)
    motion = torch.tensor([[[3.0, 4.0], [0, 0]], [[0, 1], [math.nan, 0]]])
    mask = torch.tensor([[True, True], [True, False]])
    assert end_point_error(motion, truth, mask) == pytest.approx(2)
    assert math.isnan(end_point_error(motion, truth))
    assert math.isnan(end_point_error(motion, truth, torch.zeros_like(mask)))
    assert end_point_error(torch.tensor([[1.0, 2, 2]]), torch.zeros(1, 3)) == 3


def test_outliers_are_far_in_pixels_and_in_share_or_no_numbers() -> None:
    truth = torch.tensor([[10.0, 0], [10, 0], [100, 0], [100, 0]])
    motion = truth + torch.tensor([[0, 2.9], [0, 3.1], [0, 4.0], [0, 6.0]])
    # 3.1 of 10: out; 4 of 100: below 5 %; 6 of 100: out
    assert flow_outliers(motion, truth) == 0.5
    assert flow_outliers(motion, truth, torch.tensor([True, False, True, False])) == 0
    truth = 10 * torch.ones(4, 2)
    assert flow_outliers(torch.full((4, 2), math.nan), truth) == 1
    assert flow_outliers(torch.cat([truth[:3], truth[3:] * math.nan]), truth) == 0.25


def test_track_errors_by_hand() -> None:
    truth = torch.zeros(3, 2, 3)
    tracks = truth.clone()
    tracks[1, 0, 0], tracks[2, 0, 0] = 1, 3
    tracks[2, 1, 1] = 2
    errors = track_errors(tracks, truth)
    assert errors.mean == pytest.approx((1 + 3 + 0 + 2) / 4)
    assert errors.median == pytest.approx(1.5)  # halfway between 2 and 1
    assert errors.final == pytest.approx(2.5)
    assert errors.by_time == pytest.approx((0, 0.5, 2.5))
    assert math.isnan(errors.accuracy)
    assert errors.num_tracks == 2


def test_hidden_points_do_not_count() -> None:
    truth = torch.zeros(3, 2, 2)
    tracks = truth.clone()
    tracks[1:, 0, 0] = math.nan
    tracks[1:, 1, 0] = 3
    visible = torch.tensor([[True, True], [False, True], [False, True]])
    errors = track_errors(tracks, truth, visible, image_size=256)
    assert errors.mean == errors.median == 3
    # 3 pixels lie within 4, 8 and 16, not within 1 and 2
    assert errors.accuracy == pytest.approx(3 / 5)
    # in an image twice as large they are 1.5 of 256
    assert track_errors(tracks, truth, visible, image_size=512).accuracy == pytest.approx(4 / 5)


@pytest.mark.parametrize(("measure", "shapes", "message"), [
    (track_errors, [(1, 2, 3), (1, 2, 3)], "tracks must have shape"),
    (track_errors, [(2, 2, 3), (2, 3, 3)], "truth must have shape"),
    (track_errors, [(2, 2, 2), (2, 2, 2)], "image_size must be given"),
    (end_point_error, [(2, 2), (2, 3)], "motion and truth must have one shape"),
    (end_point_error, [(2, 2), (2, 2), (3,)], "mask must have shape"),
])  # fmt: skip
def test_what_cannot_be_compared_is_named(measure: Callable, shapes: list[tuple[int, ...]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        measure(*(torch.zeros(shape) for shape in shapes))
