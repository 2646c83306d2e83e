"""A canonical field at deformed positions."""

from dataclasses import replace

import pytest
import torch
from reference import FormulaField
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.core.rays import Rays
from dnerf.deformations import CachedDeformation, Deformation
from dnerf.fields import CachedField, DeformedField, RadianceField, evaluate_along_rays

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


def some_rays() -> Rays:
    directions = torch.nn.functional.normalize(torch.randn(6, 3), dim=-1)
    return Rays(-2 * directions, directions, torch.full((6,), 0.25), torch.zeros(6), torch.full((6,), 4.0))


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


@pytest.mark.parametrize("is_cached", [True, False])
def test_along_rays_a_field_says_what_it_says_at_their_positions(is_cached: bool) -> None:
    deformation = CachedDeformation(Drift(), BOX, 4) if is_cached else Drift()
    field = DeformedField(deformation, canonical_formula()).at_time(0.25)
    assert isinstance(field, CachedField) == is_cached
    rays, numbers, distances = some_rays(), torch.arange(60) // 10, torch.rand(60) * 4
    along, at = evaluate_along_rays(field, rays, numbers, distances), field(*rays.places(numbers, distances))
    torch.testing.assert_close(along.density, at.density, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(along.rgb, at.rgb, rtol=1e-5, atol=1e-6)


def test_overrides_of_subclasses_hold_along_rays_and_for_one_time() -> None:
    class Grey(CachedField):
        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            return replace(super().forward(positions, directions, times), rgb=torch.full_like(positions, 0.25))

    class Still(CachedDeformation):
        def forward(self, positions: Tensor, times: Tensor) -> Tensor:
            return positions

    rays, numbers, distances = some_rays(), torch.arange(60) // 10, torch.rand(60) * 4
    field = Grey(CachedDeformation(Drift(), BOX, 4).at_time(0.25), canonical_formula())
    assert (evaluate_along_rays(field, rays, numbers, distances).rgb == 0.25).all()
    still = DeformedField(Still(Drift(), BOX, 4), canonical_formula())
    positions, _, times = rays.places(numbers, distances)
    torch.testing.assert_close(still.at_time(0.25).density(positions, times), positions.square().sum(-1))
