"""Displacements that are evaluated at knots along rays, and linear in between."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dnerf.deformations import CachedDeformation, Deformation, DisplacementDeformation, IdentityDeformation
from dnerf.deformations.knots import PAD_TO, between_knots

BOX = [[-1.0] * 3, [1.0] * 3]
CORNERS = st.lists(st.tuples(*[st.integers(-2, 2)] * 3), min_size=1, max_size=12)


class Counting(Deformation):
    """Moves by another map, and remembers where it was evaluated."""

    def __init__(self, move: str = "bend") -> None:
        super().__init__()
        self.is_bent = move == "bend"
        self.seen = torch.zeros(0, 3)

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        self.seen = positions
        moved = torch.sin(2 * positions.roll(1, -1)) if self.is_bent else 0.3 * positions.roll(1, -1)
        return positions + moved + torch.sin(40 * times)[..., None]

    @property
    def num_knots(self) -> int:
        return len(self.seen.unique(dim=0))


def along_rays(
    num_rays: int = 20, each: int = 60, step: float = 0.02, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    origins = torch.rand(num_rays, 1, 3, generator=generator, dtype=dtype) - 0.5
    directions = torch.nn.functional.normalize(torch.randn(num_rays, 1, 3, generator=generator, dtype=dtype), dim=-1)
    distances = step * torch.arange(each, dtype=dtype)[:, None]
    times = torch.rand(num_rays, 1, generator=generator, dtype=dtype).expand(-1, each)
    return (origins + distances * directions).reshape(-1, 3), times.reshape(-1)


def test_the_error_falls_with_the_square_of_the_spacing_within_its_bound() -> None:
    x, times = along_rays(step=0.005, each=200)
    errors = []
    for spacing in (0.4, 0.2, 0.1):
        bend = Counting()
        found = between_knots(bend, x, times, spacing)
        assert bend.num_knots <= 20 * (1.0 / spacing + 2)
        errors.append(float((found - bend(x, times)).abs().max()))
        # Along a line |f''| <= 4, and knots are less than a spacing and a step apart.
        assert errors[-1] <= 4 * (spacing + 0.005) ** 2 / 8
    assert errors[0] / errors[1] > 3.3
    assert errors[1] / errors[2] > 3.3


@given(corners=CORNERS, each=st.integers(1, 4), spacing=st.sampled_from([0.03, 0.3, 1.1, 5.0]), turn=st.booleans())
def test_a_linear_map_is_exact_whatever_the_list_holds(
    corners: list[tuple[int, int, int]], each: int, spacing: float, turn: bool
) -> None:
    """Lines that turn, double back, stand still and leap, at times that change or do not."""
    ends = torch.tensor(corners, dtype=torch.float64)
    shares = torch.arange(each, dtype=torch.float64)[:, None] / each
    x = torch.cat([torch.lerp(a, b, shares) for a, b in zip(ends, ends.roll(-1, 0), strict=True)])
    times = (torch.arange(len(x)) // 5 % 3 / 3).double() if turn else x.new_full((len(x),), 0.2)
    linear = Counting("linear")
    torch.testing.assert_close(between_knots(linear, x, times, spacing), linear(x, times), rtol=0, atol=1e-12)


def test_what_is_on_no_line_is_evaluated_as_it_is() -> None:
    x = 0.01 * torch.rand(300, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    times = x.new_full((300,), 0.5)
    bend = Counting()
    found = between_knots(bend, x, times, spacing=10.0)
    assert bend.num_knots == 300
    assert len(bend.seen) == PAD_TO
    torch.testing.assert_close(found, bend(x, times), rtol=0, atol=1e-14)


def test_samples_that_are_not_finite_stay_so_and_spoil_no_others() -> None:
    x, times = along_rays(2, 30, dtype=torch.float32)
    x[10], x[40, 1] = torch.nan, torch.inf
    found = between_knots(Counting(), x, times, spacing=0.1)
    finite = torch.isfinite(x).all(-1)
    assert not torch.isfinite(found[~finite]).all(-1).any()
    torch.testing.assert_close(found[finite], Counting()(x[finite], times[finite]), rtol=0, atol=5e-3)


def test_weights_get_the_gradient_of_the_interpolation() -> None:
    deformation = DisplacementDeformation(2, 8, position_frequencies=2, time_frequencies=2).double()
    torch.nn.init.normal_(deformation.mlp.output.weight, generator=torch.Generator().manual_seed(0))
    x, times = along_rays(3, 40, step=0.005)
    weights = tuple(deformation.parameters())
    found = [between_knots(deformation, x, times, spacing) for spacing in (1e-4, 0.02, 0.1)]
    fine, near, far, exact = (
        torch.autograd.grad(f.square().sum(), weights) for f in (*found, deformation(x, times))
    )  # fmt: skip
    torch.testing.assert_close(fine, exact)
    for a, b, c in zip(near, far, exact, strict=True):
        assert (a - c).norm() < 0.03 * c.norm()
        assert (a - c).norm() < 0.2 * (b - c).norm()


def test_knots_are_for_training_alone() -> None:
    x, times = along_rays(dtype=torch.float32)
    bend = Counting()
    cached = CachedDeformation(bend, BOX, spacing=0.05).train()
    with torch.no_grad():
        cached(x, times)
    coarse = bend.num_knots
    cached(x, times)
    assert coarse < bend.num_knots < len(x) / 2  # without gradients knots are twice as far apart
    for wanted in (cached.eval(), CachedDeformation(bend, BOX).train()):
        assert torch.equal(wanted(x, times), bend(x, times))
    for places, at in ((x.clone().requires_grad_(), times), (x, times.clone().requires_grad_())):
        assert torch.equal(cached.train()(places, at), bend(places, at))
    assert torch.equal(cached(x[None], times[None]), bend(x, times)[None])
    assert cached(x[:0], times[:0]).shape == (0, 3)


def test_bad_input() -> None:
    with pytest.raises(ValueError, match="spacing must be >= 0"):
        CachedDeformation(IdentityDeformation(), BOX, spacing=-1.0)
    with pytest.raises(ValueError, match="times"):
        CachedDeformation(Counting(), BOX, spacing=0.1).train()(torch.zeros(3, 3), torch.zeros(2))
