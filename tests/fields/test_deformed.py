"""A canonical field seen through a deformation."""

import pytest
import torch
from reference import FormulaField
from torch import Tensor

from dnerf.compositing import FieldOutput
from dnerf.deformations import CarriedBodies, Deformation, FlowDeformation, FrameLattice
from dnerf.deformations.velocities import NetworkVelocity
from dnerf.fields import Baking, DeformedField, GridField, RadianceField
from dnerf.rays import Rays


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


def test_field_is_asked_at_canonical_positions_and_the_same_times_and_directions() -> None:
    canonical = FormulaField(lambda x: x.square().sum(-1), lambda x, d, t: torch.stack([x[..., 0], d[..., 1], t], -1))
    field = DeformedField(Drift(), canonical)
    positions, directions, times = torch.randn(8, 3), torch.randn(8, 3), torch.rand(8)
    moved = positions - times[:, None] * torch.tensor([1.0, 0, 0])
    output = field(positions, directions, times)
    torch.testing.assert_close(output.density, moved.square().sum(-1))
    torch.testing.assert_close(output.rgb, torch.stack([moved[:, 0], directions[:, 1], times], -1))
    torch.testing.assert_close(field.density(positions, times), output.density)


def test_canonical_positions_come_with_the_output_and_extras_are_kept() -> None:
    positions, times = torch.randn(8, 3), torch.rand(8)
    extras = DeformedField(Drift(), Gray())(positions, positions, times).extras
    assert extras.keys() == {"halves", "positions", "carried_positions", "times", "canonical_positions"}
    assert torch.equal(extras["halves"], times / 2)
    assert torch.equal(extras["positions"], positions)
    assert torch.equal(extras["times"], times)
    assert torch.equal(extras["canonical_positions"], Drift()(positions, times))


class Counting(Drift):
    """Counts what it is asked."""

    def __init__(self) -> None:
        super().__init__()
        self.num_points = 0

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        self.num_points += len(positions)
        return super().forward(positions, times)


def test_samples_of_a_ray_share_evaluations_of_the_deformation_in_training_only() -> None:
    field = DeformedField(Counting(), Gray(), spacing=0.05)
    positions = torch.linspace(0, 1, 5001)[:, None] * torch.tensor([0.6, 0.0, 0.8])
    times = torch.full((5001,), 0.25)
    for ask in (lambda: field.density(positions, times), lambda: field(positions, positions, times)):
        for training, expected in ((True, 1024), (False, 5001)):
            field.train(training)
            field.deformation.num_points = 0
            ask()
            assert field.deformation.num_points == expected
    torch.testing.assert_close(
        field.train()(positions, positions, times).extras["canonical_positions"], Drift()(positions, times)
    )


@pytest.mark.parametrize("spacing", [0.0, -0.1, float("nan"), float("inf")])
def test_a_spacing_that_is_not_positive_is_refused(spacing: float) -> None:
    with pytest.raises(ValueError, match="spacing must be > 0 and finite"):
        DeformedField(Drift(), Gray(), spacing=spacing)


def test_motion_is_the_deformation_until_a_flow_is_fitted_instead() -> None:
    """It then stays part of fields whose contents are kept for sequences."""
    torch.manual_seed(0)
    box = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    flow = FlowDeformation(NetworkVelocity(box, 1, 8, position_frequencies=1, time_frequencies=1), num_steps=2)
    torch.nn.init.normal_(flow.velocity.mlp.output.weight)
    canonical = GridField(box, (4,), 2, hidden_features=8)
    field = DeformedField(Drift(), canonical, baking=Baking(box, 8), motion_flow=flow)
    positions, times = torch.rand(20, 3), torch.rand(20)
    assert not field.has_found_motion
    assert field.motion is field.deformation
    field.set_found_motion(True)
    moved = flow(positions, times)
    assert (moved - Drift()(positions, times)).abs().max() > 1e-3
    for kept in (field, field.finished()):
        assert torch.equal(kept.motion(positions, times), moved)
    assert field.finished() is not field
    field.set_found_motion(False)
    assert field.finished().motion is field.deformation
    # What pictures show does not change with it.
    assert torch.equal(field(positions, positions, times).extras["canonical_positions"], Drift()(positions, times))


@pytest.mark.parametrize("frozen", [True, False])
def test_along_rays_a_field_says_what_it_says_at_their_positions(frozen: bool) -> None:
    canonical = FormulaField(lambda x: x.square().sum(-1), lambda x, d, t: torch.stack([x[..., 0], d[..., 1], t], -1))
    lattice = FrameLattice([[-2.0] * 3, [2.0] * 3], 4)
    field: RadianceField = DeformedField(Drift(), canonical, frame_lattice=lattice)
    field = field.at_time(0.25) if frozen else field
    directions = torch.nn.functional.normalize(torch.randn(6, 3), dim=-1)
    rays = Rays(-2 * directions, directions, torch.full((6,), 0.25), torch.zeros(6), torch.full((6,), 4.0))
    numbers, distances = torch.arange(60) // 10, torch.rand(60) * 4
    along, at = field.along(rays, numbers, distances), field(*rays.places(numbers, distances))
    torch.testing.assert_close(along.density, at.density, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(along.rgb, at.rgb, rtol=1e-5, atol=1e-6)


def test_along_rays_carried_bodies_are_where_they_are() -> None:
    bodies = CarriedBodies(2)
    track = torch.zeros(bodies.num_knots, 3)
    bodies.add(track, torch.tensor([1.5, 1.5, 1.5]), 0.4)
    canonical = FormulaField(lambda x: x.square().sum(-1), lambda x, d, t: x)
    field = DeformedField(
        Drift(), canonical, frame_lattice=FrameLattice([[-2.0] * 3, [2.0] * 3], 4), bodies=bodies
    ).at_time(0.25)
    direction = torch.tensor([[1.0, 0.0, 0.0]])
    rays = Rays(-2 * direction, direction, torch.full((1,), 0.25), torch.zeros(1), torch.full((1,), 4.0))
    density = field.along(rays, torch.zeros(2, dtype=torch.int64), torch.tensor([1.0, 2.0])).density
    torch.testing.assert_close(density, torch.tensor([1.25**2, 2 * 1.5**2 + 1.25**2]))  # at home, the second one
