"""Where errors lie: kinds of a made image, by hand, and their shares."""

import pytest
import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.evaluation.error_kinds import KINDS, SeenFromAside, error_shares, kinds_of
from dnerf.fields import RadianceField


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


class Shiny(RadianceField):
    """Red as a direction's x, and denser with time."""

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return times

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(times, directions)


def test_from_aside_directions_are_turned_and_nothing_else() -> None:
    field, directions, times = SeenFromAside(Shiny()), torch.eye(3), torch.tensor([0.1, 0.2, 0.3])
    for seen in (field, field.at_time(0.5)):
        output = seen(torch.zeros(3, 3), directions, times)
        expected = torch.tensor([[0.75**0.5, 0.5, 0], [-0.5, 0.75**0.5, 0], [0, 0, 1]])
        torch.testing.assert_close(output.rgb, expected)
        assert torch.equal(output.density, times)


def test_inner_places_that_change_with_the_direction_are_gloss() -> None:
    alpha, change = torch.zeros(12, 20), torch.zeros(12, 20)
    alpha[:, :10] = 1
    change[:, ::2] = 0.05
    kinds = kinds_of(torch.zeros(12, 20, 3), alpha, change)
    names = [KINDS[k] for k in kinds[6].tolist()]
    assert names == ["gloss", "smooth"] * 4 + ["silhouettes"] * 4 + ["outside"] * 8


def test_shares_are_of_the_whole_error_and_of_all_pixels() -> None:
    errors, kinds = torch.tensor([[1.0, 3.0], [0.0, 4.0]]), torch.tensor([[0, 2], [4, 2]])
    shares = error_shares(errors, kinds)
    assert list(shares) == list(KINDS)
    assert shares["silhouettes"] == pytest.approx((1 / 8, 1 / 4))
    assert shares["texture"] == pytest.approx((7 / 8, 1 / 2))
    assert shares["smooth"] == (0, 0)
    assert shares["outside"] == (0, 1 / 4)
