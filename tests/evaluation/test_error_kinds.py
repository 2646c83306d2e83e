"""Where errors lie: kinds of a made image, by hand, and their shares."""

import pytest
import torch

from dnerf.evaluation.error_kinds import KINDS, error_shares, kinds_of


def test_kinds_of_a_square_with_stripes_on_one_side() -> None:
    image, alpha = torch.full((20, 30, 3), 0.5), torch.zeros(20, 30)
    alpha[4:16, 5:25] = 1
    image[:, 17::2] = 1
    kinds = kinds_of(image, alpha)
    rows, columns = torch.arange(20)[:, None], torch.arange(30)
    grown = ((rows > 1) & (rows < 18) & (columns > 2) & (columns < 27)).expand(20, 30)
    shrunk = (rows > 5) & (rows < 14) & (columns > 6) & (columns < 23)
    assert torch.equal(kinds == KINDS.index("silhouettes"), grown & ~shrunk)
    assert torch.equal(kinds == KINDS.index("texture"), shrunk & (columns >= 15))
    assert torch.equal(kinds == KINDS.index("smooth"), shrunk & (columns < 15))
    assert torch.equal(kinds == KINDS.index("outside"), ~grown)


def test_shares_are_of_the_whole_error_and_of_all_pixels() -> None:
    errors, kinds = torch.tensor([[1.0, 3.0], [0.0, 4.0]]), torch.tensor([[0, 1], [3, 1]])
    shares = error_shares(errors, kinds)
    assert list(shares) == list(KINDS)
    assert shares["silhouettes"] == pytest.approx((1 / 8, 1 / 4))
    assert shares["texture"] == pytest.approx((7 / 8, 1 / 2))
    assert shares["smooth"] == (0, 0)
    assert shares["outside"] == (0, 1 / 4)
