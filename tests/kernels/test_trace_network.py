"""Rays through a lattice and a network in one kernel against its definition, one interval after the other."""

import itertools
import sys
from collections.abc import Iterator

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.backends import serve_bfloat16, under
from torch import Tensor

from dnerf.kernels import FrameTables, GridLevels, grid_network, is_traced, skip_distances, trace_network
from dnerf.kernels.grid_network import is_fused
from dnerf.kernels.trace_network import trace_network_reference

BOX = torch.tensor([[-1.0, -0.5, 0.0], [1.0, 0.5, 1.5]])
LEVELS = GridLevels([4, (9, 6, 7)], 1 << 12)
WIDTHS = (8, 16, 16)
OPTIONS = {"step": 0.05, "subdivision": 3, "min_weight": 1e-3, "subdivision_weight": 1e-2, "stop_transmittance": 1e-3}


@pytest.fixture(autouse=True, scope="module", params=[False, True])
def fused(request: pytest.FixtureRequest) -> Iterator[None]:
    """In both precisions; and the definition asks the same network, so that only the rest may differ."""
    with pytest.MonkeyPatch.context() as patch, torch.autocast("cpu", torch.bfloat16, enabled=request.param):
        serve_bfloat16(patch)
        patch.setattr(sys.modules["dnerf.kernels.trace_network"], "grid_network_reference", grid_network)
        yield


def scene(
    seed: int = 0, *, known: float = 1.0, share: float = 0.3, density: float = 2.0, reach: float = 0.15, degree: int = 0
) -> FrameTables:
    """Cells, displacements of which a share is known, and a random network."""
    widths = (*WIDTHS, 1 + 3 * (degree + 1) ** 2)
    generator = torch.Generator().manual_seed(seed)
    cells = (5, 4, 6)
    is_known = torch.rand([c + 1 for c in reversed(cells)], generator=generator) < known
    displacements = (torch.rand(is_known.numel(), 4, generator=generator) - 0.5) * 2 * reach
    occupancy = torch.rand(16, 9, 12, generator=generator) < share
    return FrameTables(
        occupancy=occupancy, skips=skip_distances(occupancy[None])[0], aabb=BOX, is_known=is_known, low=BOX[0],
        displacements=torch.where(is_known.reshape(-1, 1), displacements, torch.nan), sides=BOX[1] - BOX[0],
        field_low=BOX[0] - 0.1, field_scale=1 / (BOX[1] - BOX[0] + 0.2), levels=LEVELS,
        table=torch.randn(LEVELS.num_rows, 4, generator=generator),
        shifts=torch.tensor([density, *[0.1, -0.1, 0.3] * (degree + 1) ** 2]),
        weights=[torch.randn(b, a, generator=generator) / a**0.5 for a, b in itertools.pairwise(widths)],
        biases=[torch.randn(b, generator=generator) for b in widths[1:]],
    )  # fmt: skip


def rays(count: int, seed: int = 0) -> tuple[Tensor, ...]:
    """Rays through the box, some that miss it, begin inside, or have no length."""
    generator = torch.Generator().manual_seed(seed)
    targets = BOX[0] + torch.rand(count, 3, generator=generator) * (BOX[1] - BOX[0]) * 1.2
    origins = torch.randn(count, 3, generator=generator) * 2
    origins[::7] = targets[::7] * 0.4
    near = torch.rand(count, generator=generator)
    far = near + torch.rand(count, generator=generator) * 8
    far[3::11] = near[3::11]
    return origins, torch.nn.functional.normalize(targets - origins, dim=-1), near, far


def both(bundle: tuple[Tensor, ...], tables: FrameTables, **options: float):
    """What the kernel finds, and its definition."""
    scalars = [options[name] for name in ("step", "min_weight", "subdivision_weight", "stop_transmittance")]
    with torch.no_grad():
        found = trace_network(*bundle, tables, **options)
        expected = trace_network_reference(list(bundle), tables, int(options["subdivision"]), scalars)
    return found, expected


def assert_same(found: tuple[Tensor, Tensor], expected: tuple[Tensor, Tensor], cutoff: float) -> None:
    """The same but for rays of which one interval's weight or light is, but for rounding, the cut-off."""
    assert ((found[1] == expected[1]) | (found[0][:, 0] <= 2 * cutoff)).all()
    both_done = found[1] & expected[1]
    errors = (found[0] - expected[0])[both_done].abs().amax(-1)
    assert float((errors > 1e-4).float().mean()) <= 0.02 if len(errors) else True
    torch.testing.assert_close(found[0][both_done], expected[0][both_done], rtol=0, atol=1e-4 + 20 * cutoff)


@settings(max_examples=25, deadline=None)
@given(
    count=st.sampled_from([0, 1, 5, 64, 65, 300, 700]), known=st.sampled_from([1.0, 0.9]),
    density=st.sampled_from([-3.0, 2.0, 6.0]), subdivision=st.sampled_from([1, 2, 3, 4]),
    stop=st.sampled_from([0.0, 1e-3, 0.1]), share=st.sampled_from([0.0, 0.3, 1.0]),
    degree=st.sampled_from([0, 0, 1, 2, 3, 4]), seed=st.integers(0, 99),
)  # fmt: skip
def test_kernel_equals_definition(count, known, density, subdivision, stop, share, degree, seed) -> None:
    tables = scene(seed, known=known, density=density, share=share, degree=degree)
    options = OPTIONS | {"subdivision": subdivision, "stop_transmittance": stop}
    found, expected = both(rays(count, seed), tables, **options)
    assert_same(found, expected, max(stop, 1e-3))


def test_closed_form_of_a_uniform_block() -> None:
    """A network of zeros leaves its shifts: density and colour are the same everywhere."""
    tables = scene(share=1.0, reach=0.0)
    nothing = {name: [torch.zeros_like(p) for p in getattr(tables, name)] for name in ("weights", "biases")}
    tables = FrameTables(**vars(tables) | nothing)
    origins = torch.tensor([[0.1, -3.0, 0.7], [-4.0, 0.2, 0.3]])
    directions = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    bundle = origins, directions, torch.zeros(2), torch.full((2,), 20.0)
    light = torch.exp(-tables.shifts[0].exp() * torch.tensor([1.0, 2.0]))
    for subdivision in (1, 3):
        options = dict.fromkeys(OPTIONS, 0.0) | {"step": 0.05, "subdivision": subdivision}
        (states, is_done), _ = both(bundle, tables, **options)
        assert is_done.all()
        torch.testing.assert_close(states[:, 0], light, rtol=2e-5, atol=1e-7)
        torch.testing.assert_close(states[:, 1:4], (1 - light)[:, None] * torch.sigmoid(tables.shifts[1:]))


def test_a_ray_sees_its_own_direction() -> None:
    """A uniform block whose red follows the first harmonic of z, and nothing else any."""
    tables = scene(share=1.0, reach=0.0, degree=1)
    nothing = {name: [torch.zeros_like(p) for p in getattr(tables, name)] for name in ("weights", "biases")}
    shifts = torch.tensor([6.0, 0, 0, 1, 0, 0, 0, 0, 0, 0.5, 0, 0, 0])
    tables = FrameTables(**vars(tables) | nothing | {"shifts": shifts})
    bundle = rays(200)
    (states, is_done), _ = both(bundle, tables, **OPTIONS)
    expected = torch.sigmoid(torch.stack([3**0.5 * bundle[1][:, 2], torch.zeros(200), torch.full((200,), 0.5)], dim=-1))
    torch.testing.assert_close(states[:, 1:4], (1 - states[:, :1]) * expected, rtol=0, atol=1e-5)
    assert is_done.all()
    assert (states[:, 0] < 0.5).sum() > 50


def test_nan_of_the_network_is_shown_and_where_nothing_is_known_rays_say_so() -> None:
    bundle, tables = rays(80), scene(share=1.0)
    poisoned = FrameTables(**vars(tables) | {"table": torch.full_like(tables.table, torch.nan)})
    (states, is_done), _ = both(bundle, poisoned, **OPTIONS)
    assert is_done.all()
    assert states.isnan().any()
    unknown = FrameTables(**vars(tables) | {"displacements": torch.full_like(tables.displacements, torch.nan)})
    (_, is_done), (_, expected) = both(bundle, unknown, **OPTIONS)
    assert torch.equal(is_done, expected)
    assert 20 < int((~is_done).sum()) < 80  # the others meet nothing


def test_rays_do_not_depend_on_their_neighbours() -> None:
    bundle, tables = rays(600), scene(density=4.0)
    (whole, _), _ = both(bundle, tables, **OPTIONS)
    for some in (torch.arange(600).flip(0), torch.arange(0, 600, 7)):
        (states, _), _ = both(tuple(x[some] for x in bundle), tables, **OPTIONS)
        assert torch.equal(states, whole[some])


def test_other_backends_take_the_definition() -> None:
    bundle, tables = rays(50), scene()
    states, is_done = under("reference", trace_network, *bundle, tables, **OPTIONS)
    assert is_done.all()
    assert bool((states[:, 0] < 0.9).any())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"occupancy": torch.ones(3, 3)}, "occupancy must be bool"),
        ({"displacements": torch.zeros(5, 4)}, "displacements must have shape"),
        ({"shifts": torch.zeros(4, dtype=torch.float64)}, "shifts must be float32"),
        ({"table": torch.zeros(5, 4)}, "table must have shape"),
        ({"weights": [torch.zeros(4, 8)]}, "at least two layers"),
        ({"weights": [torch.zeros(4, 8), torch.zeros(7, 4)]}, r"\(degree \+ 1\)\^2 outputs, got 2 layers with 7"),
        ({"weights": [torch.zeros(4, 8), torch.zeros(13, 4)]}, r"shifts must have shape \(13,\), got \(4,\)"),
    ],
)
def test_wrong_tables_are_refused(wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FrameTables(**vars(scene()) | wrong)


@pytest.mark.parametrize(("count", "subdivision", "message"), [(3, 3, r"near .* got \(3,\)"), (5, 0, "subdivision")])
def test_wrong_rays_are_refused(count: int, subdivision: int, message: str) -> None:
    origins, directions, near, far = rays(5)
    with pytest.raises(ValueError, match=message):
        trace_network(origins, directions, near[:count], far, scene(), **OPTIONS | {"subdivision": subdivision})


def test_processors_that_multiply_tiles_are_served_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """There matrix libraries are as quick at layers alone, but not at whole rays."""
    monkeypatch.setattr("dnerf.kernels.cpu.grid_network.is_supported", lambda: False)
    tables = scene()
    network = tables.table, tables.weights[0].shape[1], tables.weights
    assert is_traced(*network)
    assert is_fused(*network) != torch.is_autocast_enabled("cpu")
