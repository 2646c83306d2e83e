"""Frames through lattices in one kernel show what the chain of samplers, fields and compositing shows."""

import logging
from unittest.mock import patch

import pytest
import torch
from torch import Tensor

from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.deformations import CarriedBodies, DisplacementDeformation, FrameLattice
from dnerf.deformations.carried_bodies import NOWHERE
from dnerf.deformations.frame_lattice import FrozenDeformation
from dnerf.fields import Baking, DeformedField, GridField, RadianceField, SpaceTimeVolumes
from dnerf.fields.baked import BakedField
from dnerf.kernels import use_backend
from dnerf.kernels.cpu.dense import has_vectors
from dnerf.rays import Rays
from dnerf.renderer import Renderer
from dnerf.samplers import OccupancySampler
from dnerf.tracing import FrameTracer, NetworkTracer

BOX = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]
CAMERA = Camera(Intrinsics(32, 24, 30.0, 30.0), look_at([0.3, -3.2, 0.8], [0.0, 0.0, 0.0]))


def model(
    *,
    time_terms: int = 3,
    splits: int = 1,
    stop: float = 1e-4,
    box: list | None = None,
    max_bricks: int = 4096,
    cells: int = 24,
    brick_cells: int = 32,
    volumes: SpaceTimeVolumes | None = None,
    bodies: CarriedBodies | None = None,
    precision: str = "float32",
) -> Renderer:
    """A random body in the middle of the box, moved a little, as frames of a sequence see it."""
    torch.manual_seed(0)
    canonical = GridField(
        BOX, (4, 9), 4, time_terms=time_terms, hidden_features=16, density_shift=2.0, space_time=volumes
    )
    deformation = DisplacementDeformation(2, 16, (), position_frequencies=2, time_frequencies=2, canonical_time=None)
    with torch.no_grad():
        canonical.table.mul_(150)
        for parameter in canonical.head.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
        assert deformation.mlp.output is not None
        deformation.mlp.output.weight.add_(0.03 * torch.randn_like(deformation.mlp.output.weight))
    field = DeformedField(
        deformation, canonical,
        frame_lattice=FrameLattice(box or BOX, cells), baking=Baking(BOX, brick_cells, max_bricks=max_bricks),
        bodies=bodies,
    )  # fmt: skip
    sampler = OccupancySampler(
        BOX, 0.03 * splits, 16, num_slabs=4, splits=splits, split_weight=0.02, margin=0, pad_to=64
    )
    mask = torch.zeros(16, 16, 16, dtype=torch.bool)
    mask[5:11, 5:11, 4:12] = True
    sampler.occupy(mask)
    assert sampler.share < 0.1
    return Renderer(field, sampler, stop_transmittance=stop, precision=precision).eval().for_sequence(60)


def picture(renderer: Renderer, time: float = 0.3) -> Tensor:
    shown = renderer.render_image(CAMERA, time)
    return torch.cat([shown.rgb, shown.opacity[..., None], shown.depth[..., None]], dim=-1)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many vertices were asked for, each time that a lattice was filled."""
    counts: list[int] = []
    fill = FrozenDeformation.fill

    def counted(self: FrozenDeformation, wanted: Tensor) -> bool:
        counts.append(int(wanted.sum()))
        return fill(self, wanted)

    monkeypatch.setattr(FrozenDeformation, "fill", counted)
    return counts


@pytest.mark.parametrize("time_terms", [1, 3])
@pytest.mark.parametrize("splits", [1, 3])
def test_it_shows_what_the_chain_shows(time_terms: int, splits: int) -> None:
    stop = 1e-5
    with use_backend("reference"):
        expected = picture(model(time_terms=time_terms, splits=splits, stop=stop))
    done = []
    call = FrameTracer.__call__

    def traced(self: FrameTracer, rays: Rays) -> tuple[Tensor, Tensor]:
        sums, is_done = call(self, rays)
        done.append(is_done)
        return sums, is_done

    with patch.object(FrameTracer, "__call__", traced):
        shown = picture(model(time_terms=time_terms, splits=splits, stop=stop))
    assert torch.cat(done).all()
    assert (expected[..., 3] > 0.9).any()
    assert (expected[..., 3] == 0).any()
    assert expected[..., :3].std() > 0.05
    # Where opaque rays end and what is left out differ by the cut-off for each interval.
    torch.testing.assert_close(shown, expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize("ahead", [0, 100])
def test_rays_that_meet_carried_bodies_are_left_to_the_field(ahead: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dnerf.deformations.frame_lattice.VERTICES_PER_RAY", ahead)
    bodies = CarriedBodies(2, 5)
    track = torch.tensor([[-0.3, 0.0, 0.1], [-0.05, 0.05, 0.05], [0.2, 0.1, 0.0], [0.25, 0.05, 0.05], [0.3, 0.0, 0.1]])
    bodies.add(track, torch.tensor([0.8, 0.8, 0.8]), 0.12)
    bodies.add(torch.full((5, 3), NOWHERE), torch.tensor([0.1, -0.2, -0.3]), 0.1)  # it is not there
    with use_backend("reference"):
        expected = picture(model(stop=1e-5, bodies=bodies))
        without = picture(model(stop=1e-5))
    done = []
    call = FrameTracer.__call__

    def traced(self: FrameTracer, rays: Rays) -> tuple[Tensor, Tensor]:
        sums, is_done = call(self, rays)
        done.append((rays, is_done))
        return sums, is_done

    with patch.object(FrameTracer, "__call__", traced):
        shown = picture(model(stop=1e-5, bodies=bodies))
    torch.testing.assert_close(shown, expected, rtol=0, atol=1e-3)
    assert float((expected - without).abs().max()) > 0.03
    [(rays, is_done)] = done
    center = bodies.centers(0, torch.tensor(0.3)).detach()
    for place, radius in ((center, 0.12), (bodies.homes[1], 0.1)):
        way = place - rays.origins
        nearest = (way - (way * rays.directions).sum(-1, keepdim=True) * rays.directions).norm(dim=-1)
        assert bool((nearest < radius).any())
        assert not bool(is_done[nearest < radius].any())
    assert float(is_done.float().mean()) > 0.7


def test_what_is_filled_ahead_is_most_of_it_and_changes_nothing(
    asked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dnerf.deformations.frame_lattice.VERTICES_PER_RAY", 100)  # all around occupied cells
    ahead = picture(model(splits=3))
    assert asked[0] > 0.9 * sum(asked)
    asked.clear()
    monkeypatch.setattr("dnerf.deformations.frame_lattice.VERTICES_PER_RAY", 0)  # rays find what they want
    torch.testing.assert_close(ahead, picture(model(splits=3)), rtol=0, atol=1e-6)
    assert asked[0] < 0.9 * sum(asked)


def test_frames_do_not_depend_on_those_before(asked: list[int]) -> None:
    """Which vertices are asked together depends on a frame alone: other numbers of rows may round otherwise."""
    renderer = model()
    alone = picture(model(), 0.8)
    sizes = asked.copy()
    picture(renderer, 0.1)
    asked.clear()
    picture(renderer, 0.8)
    assert asked == sizes
    assert torch.equal(picture(renderer, 0.8), alone)
    assert torch.equal(picture(renderer, 0.8), alone)


def test_matter_outside_the_lattice_is_asked_for_itself() -> None:
    small = [[-0.2, -0.2, -0.2], [0.2, 0.2, 0.2]]
    with use_backend("reference"):
        expected = picture(model(box=small))
    torch.testing.assert_close(picture(model(box=small)), expected, rtol=0, atol=1e-3)


def test_without_room_for_bricks_the_field_itself_is_asked(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        shown = picture(model(max_bricks=2))
        with use_backend("reference"):
            expected = picture(model(max_bricks=2))
    assert "no room" in caplog.text
    torch.testing.assert_close(shown, expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize("backend", ["auto", "reference"])
@pytest.mark.parametrize("splits", [1, 3])
def test_nan_is_shown_not_hidden(splits: int, backend: str) -> None:
    renderer = model(splits=splits)
    with torch.no_grad():
        for parameter in renderer.field.deformation.parameters():  # type: ignore[union-attr]
            parameter.fill_(torch.nan)
    with use_backend(backend):
        assert picture(renderer).isnan().any()


def test_chunks_change_nothing() -> None:
    whole = picture(model())
    renderer = model()
    parts = renderer.render_image(CAMERA, 0.3, chunk=100)
    assert torch.equal(parts.rgb, whole[..., :3])


def test_it_is_used_only_where_it_shows_the_same() -> None:
    renderer = model()
    grid, at = renderer.sampler.grid_at(0.3, torch.float32), renderer.field.at_time
    assert FrameTracer.of(at(0.3), grid, 0.3, 1e-3) is not None
    assert FrameTracer.of(at(0.3), None, 0.3, 1e-3) is None
    assert FrameTracer.of(renderer.field, grid, 0.3, 1e-3) is None
    with use_backend("reference"):
        assert FrameTracer.of(at(0.3), grid, 0.3, 1e-3) is None

    class Other(GridField):
        def series_at(self, time: float) -> None:
            return None

    field: RadianceField = DeformedField(
        renderer.field.deformation,
        Baking(BOX, 8).bake(Other(BOX, (4,))),
        frame_lattice=FrameLattice(BOX, 4),  # type: ignore[union-attr]
    )
    assert FrameTracer.of(field.at_time(0.3), grid, 0.3, 1e-3) is None


def test_what_space_time_volumes_add_is_kept_on_the_lattice() -> None:
    """It is linear between vertices: the error falls with the cells' size, faster where the field is smooth."""
    torch.manual_seed(0)
    volumes = SpaceTimeVolumes(BOX, (3,), (2,), num_features=2)
    for table in volumes.tables:
        torch.nn.init.normal_(table, std=0.7)
    waiting = SpaceTimeVolumes(BOX, (3,), (2,), num_features=2, waits=True)
    with use_backend("reference"):  # asks the field itself
        exact, without = (picture(model(volumes=x, splits=3))[..., :3] for x in (volumes, waiting))
    errors = []
    for cells in (12, 24, 48):
        renderer = model(volumes=volumes, splits=3, cells=cells, brick_cells=128)
        with patch.object(GridField, "forward", side_effect=AssertionError):
            errors.append(float((picture(renderer)[..., :3] - exact).square().mean().sqrt()))
    assert float((without - exact).square().mean().sqrt()) > 10 * errors[1]
    assert errors[0] > 2.5 * errors[1] > 6 * errors[2]


vectors = pytest.mark.skipif(not has_vectors(), reason="this CPU multiplies no vectors in bfloat16")


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> list[Tensor]:
    """Networks are asked by kernels, also on CPUs that multiply tiles; of which rays (R,) they were to their end."""
    monkeypatch.setattr("dnerf.kernels.cpu.grid_network.is_supported", lambda: True)
    monkeypatch.setattr("dnerf.deformations.frame_lattice.VERTICES_PER_RAY", 100)  # these pictures are small
    done: list[Tensor] = []
    call = NetworkTracer.__call__

    def traced(self: NetworkTracer, rays: Rays) -> tuple[Tensor, Tensor]:
        sums, is_done = call(self, rays)
        done.append(is_done)
        return sums, is_done

    monkeypatch.setattr(NetworkTracer, "__call__", traced)
    return done


def chain(renderer: Renderer, time: float = 0.3) -> Tensor:
    """The picture by rounds of samples."""
    with patch.object(NetworkTracer, "of", return_value=None):
        return picture(renderer, time)


@vectors
@pytest.mark.parametrize("time_terms", [1, 3])
@pytest.mark.parametrize("splits", [1, 3])
def test_frames_alone_by_one_kernel_are_those_by_rounds(time_terms: int, splits: int, network: list[Tensor]) -> None:
    renderer = model(time_terms=time_terms, splits=splits, stop=1e-4, precision="bfloat16")
    expected = chain(renderer)
    assert not network
    shown = picture(renderer)
    assert torch.cat(network).all()
    assert (expected[..., 3] > 0.9).any()
    assert expected[..., :3].std() > 0.05
    # Rounding decides what is seen of what is hardly seen; depths are of pixels with some opacity.
    torch.testing.assert_close(shown[..., :4], expected[..., :4], rtol=0, atol=3e-3)
    is_there = expected[..., 3] > 0.1
    torch.testing.assert_close(shown[is_there], expected[is_there], rtol=0, atol=2e-2)
    assert torch.equal(picture(renderer), shown)
    parts = renderer.render_image(CAMERA, 0.3, chunk=100)
    assert torch.equal(parts.rgb, shown[..., :3])


@vectors
def test_sequences_keep_no_bricks_where_a_kernel_asks_the_field(network: list[Tensor]) -> None:
    renderer = model(precision="bfloat16")
    assert renderer.for_sequence(60) is renderer
    assert not isinstance(renderer.field.canonical, BakedField)  # type: ignore[union-attr]
    picture(renderer)
    assert network
    assert isinstance(model().field.canonical, BakedField)  # type: ignore[union-attr]
    with use_backend("reference"):
        assert isinstance(model(precision="bfloat16").field.canonical, BakedField)  # type: ignore[union-attr]


@vectors
def test_rays_that_a_kernel_cannot_follow_are_shown_all_the_same(network: list[Tensor]) -> None:
    small = model(box=[[-0.2, -0.2, -0.2], [0.2, 0.2, 0.2]], cells=12, precision="bfloat16")
    torch.testing.assert_close(picture(small)[..., :4], chain(small)[..., :4], rtol=0, atol=3e-3)
    assert not torch.cat(network).all()
    network.clear()
    bodies = CarriedBodies(2, 5)
    bodies.add(torch.tensor([[0.0, 0.0, 0.1]]).repeat(5, 1), torch.tensor([0.8, 0.8, 0.8]), 0.12)
    carried = model(bodies=bodies, precision="bfloat16")
    torch.testing.assert_close(picture(carried)[..., :4], chain(carried)[..., :4], rtol=0, atol=3e-3)
    assert 0.5 < float(torch.cat(network).float().mean()) < 1


@vectors
def test_kernels_are_used_only_where_they_show_the_same(network: list[Tensor]) -> None:
    torch.manual_seed(0)
    volumes = SpaceTimeVolumes(BOX, (3,), (2,), num_features=2)
    for renderer in (model(), model(volumes=volumes, precision="bfloat16")):
        picture(renderer)
    assert not network


@vectors
@pytest.mark.parametrize("splits", [1, 3])
def test_nan_is_shown_by_a_kernel_too(splits: int, network: list[Tensor]) -> None:
    for part in ("deformation", "canonical"):
        renderer = model(splits=splits, precision="bfloat16")
        with torch.no_grad():
            for parameter in getattr(renderer.field, part).parameters():
                parameter.fill_(torch.nan)
        assert picture(renderer).isnan().any()
    assert network
