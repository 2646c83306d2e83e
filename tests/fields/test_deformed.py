"""A canonical field at deformed positions."""

import torch
from reference import FormulaField
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.deformations import CachedDeformation, Deformation
from dnerf.fields import DeformedField, RadianceField

BOX = [[-2.0] * 3, [2.0] * 3]


class Drift(Deformation):
    """The world moves along x by the time: canonical = world - time."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return positions - times[..., None] * positions.new_tensor([1.0, 0.0, 0.0])


class Gray(RadianceField):
    """Says more than density and colour."""

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return torch.ones_like(times)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), torch.full_like(positions, 0.5), {"halves": times / 2})


def canonical_formula() -> FormulaField:
    return FormulaField(lambda x: x.square().sum(-1), lambda x, d, t: torch.stack([x[..., 0], d[..., 1], t], -1))


def test_field_is_evaluated_at_canonical_positions_and_the_same_times_and_directions() -> None:
    field = DeformedField(Drift(), canonical_formula())
    positions, directions, times = torch.randn(8, 3), torch.randn(8, 3), torch.rand(8)
    moved = positions - times[:, None] * torch.tensor([1.0, 0, 0])
    output = field(positions, directions, times)
    torch.testing.assert_close(output.density, moved.square().sum(-1))
    torch.testing.assert_close(output.rgb, torch.stack([moved[:, 0], directions[:, 1], times], -1))
    torch.testing.assert_close(field.density(positions, times), output.density)


def test_canonical_positions_come_with_the_output_and_extras_are_kept() -> None:
    positions, times = torch.randn(8, 3), torch.rand(8)
    extras = DeformedField(Drift(), Gray())(positions, positions, times).extras
    assert extras.keys() == {"halves", "positions", "times", "canonical_positions"}
    assert torch.equal(extras["halves"], times / 2)
    assert torch.equal(extras["positions"], positions)
    assert torch.equal(extras["times"], times)
    assert torch.equal(extras["canonical_positions"], Drift()(positions, times))


def test_overrides_of_subclasses_hold_for_one_time() -> None:
    class Still(CachedDeformation):
        def forward(self, positions: Tensor, times: Tensor) -> Tensor:
            return positions

    still = DeformedField(Still(Drift(), BOX, 4), canonical_formula())
    positions, times = torch.randn(60, 3), torch.full((60,), 0.25)
    torch.testing.assert_close(still.at_time(0.25).density(positions, times), positions.square().sum(-1))
