"""Occupancy-guided sampling: empty space is skipped, bodies never are, and what was lost comes back."""

import math
from dataclasses import replace

import pytest
import torch
from reference import FormulaField, fog, occupancy_sampler, rays_towards_origin
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.compositing import FieldOutput, composite, render_weights
from dnerf.core.rays import Rays
from dnerf.fields import RadianceField
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import Capacity, OccupancySampler, Sampler
from dnerf.samplers.occupancy_grid import spread_over

BOX = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]


class MovingBall(RadianceField):
    """A ball of radius 0.2 and density 50 that moves along x from -0.6 to 0.6."""

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        center = torch.stack([1.2 * times - 0.6, 0 * times, 0 * times], -1)
        return 50.0 * ((positions - center).norm(dim=-1) < 0.2)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), torch.ones_like(positions))


def small(**options: object) -> OccupancySampler:
    return occupancy_sampler(BOX, 0.02, 16, **{"num_slabs": 8, "num_probes": 4096, "pad_to": 1, **options})


def opacity(sampler: Sampler, field: RadianceField) -> tuple[Tensor, int]:
    """Opacities of a hundred rays, and the number of samples they took."""
    rays = rays_towards_origin(100)
    samples = sampler.eval()(rays, field)
    output = field(samples.locate(rays)[0], samples.per_sample(rays.directions), samples.per_sample(rays.times))
    return composite(samples, output).opacity, samples.starts.numel()


def test_a_filled_grid_gives_the_same_image_with_fewer_samples() -> None:
    everything, guided = small(), small()
    guided.grid.fill(MovingBall())
    (exact, many), (fast, few) = opacity(everything, MovingBall()), opacity(guided, MovingBall())
    assert exact.max() > 0.9
    torch.testing.assert_close(fast, exact, rtol=0, atol=1e-5)
    assert few < 0.3 * many


def test_cells_are_looked_up_at_the_time_of_the_ray() -> None:
    """The slab of a time knows where the ball is then, not where it ever is."""
    sampler = small(dilation=0)
    sampler.grid.fill(MovingBall())
    first, last = sampler.grid.occupied[0].any(-1).any(-1), sampler.grid.occupied[-1].any(-1).any(-1)
    assert first[:5].any()
    assert not first[10:].any()
    assert last[11:].any()
    assert not last[:6].any()


def test_occupied_cells_are_widened_by_one_cell_and_one_slab() -> None:
    sampler = small()
    sampler.grid.maxima.zero_()
    sampler.grid.maxima[3, 7, 8, 0] = 100.0
    sampler.grid.decide()
    slabs, x, y, z = (sampler.grid.occupied.nonzero()[:, axis].unique().tolist() for axis in range(4))
    assert (slabs, x, y, z) == ([2, 3, 4], [6, 7, 8], [7, 8, 9], [0, 1])
    assert sampler.grid.occupied.sum() == 3 * 3 * 3 * 2


def test_images_may_do_without_dilation_in_space() -> None:
    sampler = small(render_dilation=0)
    sampler.grid.maxima.zero_()
    sampler.grid.maxima[3, 6:10, 6:10, 6:10] = 100.0
    sampler.grid.decide()
    assert sampler.grid.occupied.sum() == 3 * 6**3
    assert sampler.grid.rendered is not None
    # Slab 3 is halves 6 and 7; the half before and the half after see it as well.
    assert sampler.grid.rendered.sum() == 4 * 4**3
    assert sampler.grid.rendered[5:9, 6:10, 6:10, 6:10].all()
    trained, rendered = (opacity_samples(sampler.train(mode)) for mode in (True, False))
    assert 0 < rendered < trained
    loaded = small(render_dilation=0)
    loaded.load_state_dict(sampler.state_dict())
    assert opacity_samples(loaded.eval()) == rendered


def test_a_filled_grid_keeps_its_dilation_in_images() -> None:
    """Eight probes of a cell can miss the corner of a body that no training sample has ever met."""
    sampler = small(render_dilation=0)
    sampler.grid.fill(MovingBall())
    assert sampler.grid.rendered is not None
    assert sampler.grid.rendered.equal(sampler.grid.occupied.repeat_interleave(2, dim=0))


def test_intervals_of_training_shrink_to_those_of_images() -> None:
    sampler = small(coarse_step=0.08, coarse_until=0.5)
    rays = rays_towards_origin(20)

    def length() -> float:
        samples = sampler(rays, fog(1.0), generator=torch.Generator().manual_seed(0))
        return float(samples.lengths.median())

    lengths = []
    for progress in (0.0, 0.25, 0.5, 1.0):
        sampler.train().set_progress(progress)
        lengths.append(length())
        assert sampler.eval() is sampler
        assert length() == pytest.approx(0.02, rel=1e-4)
    assert lengths == pytest.approx([0.08, 0.04, 0.02, 0.02], rel=1e-4)


def test_training_cuts_what_is_visible_once_intervals_have_their_length() -> None:
    sampler = small(coarse_step=0.04, coarse_until=0.5, subdivision=4, render_subdivision=5, min_weight=1e-4)
    rays = rays_towards_origin(20)

    def length() -> float:
        return float(sampler(rays, fog(1.0), generator=torch.Generator().manual_seed(0)).lengths.median())

    for progress, expected in ((0.0, 0.04), (0.49, 0.0203), (0.5, 0.005), (1.0, 0.005)):
        sampler.train().set_progress(progress)
        assert length() == pytest.approx(expected, rel=1e-2)
        sampler.eval()
        assert length() == pytest.approx(0.004, rel=1e-3)


def test_what_weighs_little_stays_whole() -> None:
    """A step of fog of density 1 weighs up to 0.02, and less the more lies in front."""
    rays, lengths = rays_towards_origin(20), {}
    for subdivision_weight in (0.0, 0.015, 0.5):
        sampler = small(subdivision=4, min_weight=1e-4, subdivision_weight=subdivision_weight).train()
        sampler.set_progress(1.0)
        samples = sampler(rays, fog(1.0), generator=torch.Generator().manual_seed(0))
        lengths[subdivision_weight] = samples.lengths[samples.lengths > 0]
        assert float(samples.lengths.sum()) == pytest.approx(float(lengths[0.0].sum()), rel=1e-3)
        if subdivision_weight == 0.015:
            weights = render_weights(samples.lengths, samples)
            is_part = samples.lengths < 0.006
            assert weights[~is_part].max() <= 0.015 * 1.001
            assert weights[is_part & (samples.lengths > 0.0049)].min() >= 0.015 / 4 * 0.98
            assert 0.1 < is_part.float().mean() < 0.9
    assert (lengths[0.0] < 0.006).all()
    assert (lengths[0.5] > 0.006).float().mean() > 0.9


def test_images_evaluate_at_short_intervals_where_something_is_visible() -> None:
    """The image of long marched intervals, cut, is that of short ones, up to what the filter leaves out."""
    camera = Camera(Intrinsics(24, 24, 30.0, 30.0), look_at([0.0, -3.0, 0.5], [0.0, 0.0, 0.0]))
    evaluated: list[int] = []

    class Counting(MovingBall):
        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            evaluated.append(len(times))
            return super().forward(positions, directions, times)

    opacities, counts = [], []
    for subdivision in (1, 5):
        sampler = occupancy_sampler(BOX, 0.01 * subdivision, 16, num_slabs=8, subdivision=subdivision, pad_to=1)
        sampler.grid.fill(MovingBall())
        renderer = Renderer(Counting(), sampler, stop_transmittance=1e-4)
        opacities.append(renderer.render_image(camera, 0.4).opacity)
        counts.append(sum(evaluated))
        evaluated.clear()
    assert counts[1] < 0.6 * counts[0]
    difference = (opacities[1] - opacities[0]).abs()
    # At an edge the two march through other intervals; elsewhere both see an opaque ball.
    assert difference.quantile(0.95) < 1e-3
    assert difference.mean() < 0.01


@pytest.mark.parametrize("subdivision", [2, 3, 4])
@pytest.mark.parametrize("subdivision_weight", [0.0, 0.04])
def test_what_is_known_of_parts_is_not_evaluated_again(subdivision: int, subdivision_weight: float) -> None:
    """What comes back is what the field says at the middles of all parts; evaluated are those that are new."""

    class Fog(RadianceField):
        evaluated: list[Tensor] = []

        def density(self, positions: Tensor, times: Tensor) -> Tensor:
            return 3 * torch.exp(positions[..., 0])

        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            self.evaluated.append(positions)
            return FieldOutput(self.density(positions, times), torch.sigmoid(positions))

    rays = rays_towards_origin(40)
    sampler, field = small(subdivision=subdivision, subdivision_weight=subdivision_weight).eval(), Fog()
    first, light = sampler.first(rays, 30), torch.linspace(0.1, 1, 40)
    Fog.evaluated = []
    parts, output = sampler.refined(first, rays, field, light, 0.01)
    places = parts.locate(rays)[0]
    torch.testing.assert_close(output.density, field.density(places, places[:, 0]), rtol=1e-5, atol=0)
    torch.testing.assert_close(output.rgb, torch.sigmoid(places), rtol=0, atol=1e-6)
    weights = render_weights(field.density(first.locate(rays)[0], light) * first.lengths, first)
    weights = weights * first.per_sample(light)
    num_split = int((weights > max(subdivision_weight, 0.01)).sum())
    num_whole = int((weights > 0.01).sum()) - num_split
    assert num_split > 50
    assert (num_whole > 50) == (subdivision_weight > 0)
    assert len(parts.starts) == num_split * subdivision + num_whole
    assert len(Fog.evaluated[0]) == len(first.starts)
    assert len(Fog.evaluated[1]) == num_split * (subdivision - subdivision % 2)  # the middle of three parts is known
    assert len(Fog.evaluated) == 2


def test_probes_reach_every_cell_of_a_large_grid() -> None:
    """float32 has no odd numbers beyond 2^24."""
    sampler = small()
    probes = sampler.probes(sampler.grid.update_every)
    assert probes is not None
    cells = (probes[:, 0] * 2**25).long()  # as many as those of 16 slabs of 128 x 128 x 128
    assert 0.45 < (cells % 2).float().mean() < 0.55


def test_cells_can_be_set() -> None:
    sampler = small(render_dilation=0)
    sampler.grid.occupy(torch.tensor(False))
    assert opacity_samples(sampler.train()) == opacity_samples(sampler.eval()) == 0
    mask = torch.zeros(16, 16, 16, dtype=torch.bool)
    mask[4:8] = True
    sampler.grid.occupy(mask)
    assert opacity_samples(sampler.eval()) > 0
    assert sampler.grid.occupied.sum() == 8 * mask.sum()


def opacity_samples(sampler: OccupancySampler) -> int:
    generator = torch.Generator().manual_seed(0)
    return int((sampler(rays_towards_origin(300), MovingBall(), generator=generator).lengths > 0).sum())


def test_a_thin_uniform_start_empties_nothing() -> None:
    sampler = small()
    for step in range(0, 641, 16):
        sampler.update(fog(1e-2), step)
    assert sampler.grid.occupied.all()


def test_updates_drop_empty_space_and_keep_bodies() -> None:
    sampler = small(num_probes=1 << 15)
    for step in range(0, 641, 16):
        sampler.update(MovingBall(), step)
    exact, many = opacity(small(), MovingBall())
    guided, few = opacity(sampler, MovingBall())
    assert few < 0.6 * many
    torch.testing.assert_close(guided, exact, rtol=0, atol=1e-2)


def test_a_lost_body_comes_back() -> None:
    sampler = small(num_probes=1 << 16)
    sampler.grid.fill(FormulaField(lambda x: 50.0 * (x[..., 0] < -0.8), lambda x, d, t: x))
    assert opacity(sampler, MovingBall())[0].max() < 0.9
    for step in range(16, 321, 16):
        sampler.update(MovingBall(), step)
    torch.testing.assert_close(opacity(sampler, MovingBall())[0], opacity(small(), MovingBall())[0], rtol=0, atol=1e-2)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_no_number_somewhere_empties_nothing_elsewhere_and_decays(value: float) -> None:
    sampler, ball = small(decay=0.5), MovingBall()
    sampler.grid.fill(ball)
    occupied = sampler.grid.occupied.clone()
    place = torch.tensor([[0.9, 0.9, 0.9]])
    sampler.observe(place, torch.zeros(1), torch.tensor([value]))
    sampler.grid.decide()
    assert bool(sampler.grid.occupied[occupied].all())
    assert bool(sampler.grid.occupied[0, 15, 15, 15])  # samples will see what is wrong there
    for step in range(sampler.grid.update_every, 60 * sampler.grid.update_every, sampler.grid.update_every):
        sampler.update(ball, step)
    assert not bool(sampler.grid.occupied[0, 15, 15, 15])
    assert bool(sampler.grid.maxima.isfinite().all())


def test_updates_only_happen_at_their_steps() -> None:
    sampler = small()
    before = sampler.grid.maxima.clone()
    for step in (0, 1, 15, 17):
        sampler.update(MovingBall(), step)
    assert torch.equal(sampler.grid.maxima, before)
    sampler.update(MovingBall(), 16)
    assert not torch.equal(sampler.grid.maxima, before)


def test_training_samples_raise_the_maxima_of_their_own_cells() -> None:
    sampler = small().train()
    rays = rays_towards_origin(50)
    samples = sampler(rays, fog(), generator=torch.Generator().manual_seed(0))
    density = torch.rand(samples.starts.shape) * 100
    expected = sampler.grid.maxima.clone()
    positions, times = samples.locate(rays)[0], samples.per_sample(rays.times)
    for (x, y, z), t, value in zip(positions.tolist(), times.tolist(), density.tolist()):
        cell = [min(max(math.floor(8 * t), 0), 7), *(min(max(math.floor(8 * (c + 1)), 0), 15) for c in (x, y, z))]
        expected[tuple(cell)] = max(expected[tuple(cell)].item(), value)
    sampler.observe(positions, times, density)
    # A position on a cell's face may round to either side.
    assert (sampler.grid.maxima != expected).sum() <= 4
    assert (sampler.grid.maxima > 50).sum() > 100


@pytest.mark.parametrize(("options", "message"), [
    ({"num_slabs": 0}, "num_slabs must be > 0"), ({"num_probes": 0}, "num_probes must be > 0"),
    ({"update_every": 0}, "update_every must be > 0"), ({"threshold": 0.0}, "threshold must be > 0"),
    ({"decay": 1.0}, r"decay must be in \(0, 1\)"), ({"dilation": 2}, "^dilation must be 0 or 1"),
    ({"render_dilation": 2}, "render_dilation must be 0 or 1"),
    ({"subdivide_from": -0.1}, r"subdivide_from must be in \[0, 1\], got -0.1"),
    ({"subdivision": 0}, "^subdivision must be > 0"),
    ({"subdivision_weight": 1.0}, r"subdivision_weight must be in \[0, 1\), got 1.0"),
    ({"subdivision_weight": math.nan}, r"subdivision_weight must be in \[0, 1\), got nan"),
    ({"min_weight": 1.0}, r"min_weight must be in \[0, 1\), got 1.0"),
    ({"chance_weight": 1.0}, r"chance_weight must be in \[0, 1\), got 1.0"),
    ({"min_weight": -3.0}, r"min_weight must be in \[0, 1\), got -3.0"),
    ({"render_subdivision": 0}, "render_subdivision must be > 0"),
    ({"narrow_from": 1.5}, r"narrow_from must be in \[0, 1\]"),
])  # fmt: skip
def test_numbers_out_of_range_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small(**options)


def test_padding_rounds_the_number_of_samples_up_and_changes_no_image() -> None:
    plain, padded = small(), small(pad_to=512)
    for sampler in (plain, padded):
        sampler.grid.fill(MovingBall())
        sampler.eval()
    rays = rays_towards_origin(40)
    # The last rays miss everything, so that padding must go to a ray before them.
    rays = Rays(rays.origins, torch.cat([rays.directions[:30], -rays.directions[30:]]), rays.times, rays.near, rays.far)
    field = MovingBall()
    images = []
    for sampler in (plain, padded):
        samples = sampler.train()(rays, field, generator=torch.Generator().manual_seed(0))
        counted = torch.bincount(samples.ray_indices, minlength=len(rays))
        assert torch.equal(samples.offsets.diff(), counted)
        images.append((len(samples.starts), composite(samples, field(*samples.locate(rays)))))
    assert images[0][0] % 512 != 0
    assert images[1][0] == images[0][0] + (-images[0][0] % 512)
    assert torch.equal(images[0][1].opacity, images[1][1].opacity)
    assert torch.equal(images[0][1].rgb, images[1][1].rgb)
    assert len(padded.eval()(rays, field).starts) == len(plain.eval()(rays, field).starts)


def test_training_drops_the_dilation_when_told() -> None:
    sampler = small(render_dilation=0, narrow_from=0.3)
    sampler.grid.fill(MovingBall())
    sampler.grid.decide()
    rays = rays_towards_origin(40)

    def count() -> int:
        return len(sampler(rays, MovingBall(), generator=torch.Generator().manual_seed(0)).starts)

    sampler.train().set_progress(0.29)
    wide = count()
    sampler.set_progress(0.3)
    narrow = count()
    sampler.set_progress(0.29)
    assert 0 < narrow < 0.8 * wide
    assert count() == wide


def camera_at(eye: tuple[float, float, float], pixel_origin: str = "center") -> Camera:
    return Camera(Intrinsics.from_angle(33, 21, 0.6, pixel_origin), look_at(eye), 0.5, 6.0)


@pytest.mark.parametrize("pixel_origin", ["center", "corner"])
@pytest.mark.parametrize("density", [0.0, 0.002, 0.05])
def test_no_pixel_is_lost_that_has_samples(density: float, pixel_origin: str) -> None:
    """Random cells, random views: what `visible_rays` leaves out marches through nothing."""
    sampler = small(dilation=1, render_dilation=0).eval()
    left_out = 0
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        sampler.grid.occupy(torch.rand(sampler.grid.occupied.shape, generator=generator) < density)
        eye, time = torch.randn(3, generator=generator), float(torch.rand((), generator=generator))
        camera = camera_at(tuple((3 * eye / eye.norm()).tolist()), pixel_origin)
        found = sampler.visible_rays(camera, time)
        assert found is not None
        seen, rays = found
        assert torch.equal(seen, seen.unique())
        whole, cut = sampler(camera.rays(time), fog(1.0)), sampler(rays, fog(1.0))
        assert torch.isin(whole.ray_indices, seen).all()
        # Where rays are cut short, intervals stay, up to rounding, which may take a middle across a cell's face.
        counts = torch.zeros(camera.intrinsics.width * camera.intrinsics.height, dtype=torch.int64)
        counts[seen] = cut.offsets.diff()
        same = whole.offsets.diff() == counts
        assert (~same).sum() <= 3
        for name in ("starts", "ends"):
            a, b = getattr(whole, name)[same[whole.ray_indices]], getattr(cut, name)[same[seen][cut.ray_indices]]
            torch.testing.assert_close(a, b, rtol=0, atol=2e-6)
        assert (rays.far - rays.near <= (camera.rays(time).far - camera.rays(time).near)[seen] + 1e-6).all()
        left_out += camera.intrinsics.width * camera.intrinsics.height - len(seen)
    assert left_out > 0


def test_one_cell_is_seen_through_its_own_rectangle_only() -> None:
    sampler = small(dilation=0, render_dilation=0).eval()
    mask = torch.zeros_like(sampler.grid.occupied)
    mask[:, 8, 8, 8] = True
    sampler.grid.occupy(mask)
    camera = camera_at((3.0, 0.0, 0.0))
    seen, rays = sampler.visible_rays(camera, 0.3)
    length = 0.125 * 3**0.5 + 5 * sampler.step_size  # the cell's, and room
    assert (rays.far - rays.near < length).all()
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 0.125])] * 3)
    columns, rows = camera.project(corners)[0].unbind(-1)
    assert seen.remainder(33).min() >= columns.min() - 1
    assert seen.remainder(33).max() <= columns.max() + 1
    assert seen.div(33, rounding_mode="floor").min() >= rows.min() - 1
    assert seen.div(33, rounding_mode="floor").max() <= rows.max() + 1


def test_all_pixels_are_seen_from_within_the_grid() -> None:
    sampler = small().eval()
    assert sampler.visible_rays(camera_at((0.2, 0.1, 0.3)), 0.5) is None


def test_the_grid_of_evaluation_decides_what_is_seen() -> None:
    sampler = small(dilation=1, render_dilation=0, num_slabs=2).eval()
    sampler.grid.occupied.fill_(True)
    sampler.grid.rendered.fill_(False)
    assert len(sampler.visible_rays(camera_at((3.0, 0.0, 0.0)), 0.5)[0]) == 0


@pytest.mark.parametrize("most", [1, 3, 8])
def test_first_samples_and_what_follows_are_all_samples(most: int) -> None:
    """Marched piece by piece, each from the end of the last, a ray has the samples of one march."""
    sampler = occupancy_sampler(BOX, 0.05, 16, dilation=0).eval()
    generator = torch.Generator().manual_seed(4)
    sampler.grid.occupy(torch.rand(sampler.grid.occupied.shape, generator=generator) < 0.3)
    rays = rays_towards_origin(40)
    whole = sampler(rays, fog())
    begins, pieces = rays.near.clone(), []
    for _ in range(200):
        part = sampler.first(replace(rays, near=begins), most)
        assert int(part.offsets.diff().max()) <= most
        pieces.append(part)
        if not len(part.starts):
            break
        last = part.offsets.diff() > 0
        begins[last] = part.ends[part.offsets[1:][last] - 1]
    starts = torch.cat([p.starts for p in pieces])
    indices = torch.cat([p.ray_indices for p in pieces if p.ray_indices is not None])
    order = indices.argsort(stable=True)
    assert torch.equal(indices[order], whole.ray_indices)
    # The end of one piece is the origin of the next: an interval's place rounds differently.
    torch.testing.assert_close(starts[order], whole.starts, rtol=0, atol=2e-6)


@pytest.mark.parametrize("share", [0.0, 0.02, 1.0])
def test_places_are_found_without_a_list_of_them(share: float) -> None:
    generator = torch.Generator().manual_seed(0)
    mask, unit = torch.rand(3, 4, 5, generator=generator) < share, torch.rand(200, generator=generator)
    listed = mask.view(-1).nonzero()[:, 0] if mask.any() else torch.arange(60)
    assert torch.equal(spread_over(mask, unit), listed[(unit * len(listed)).long()])


def test_places_lie_in_occupied_cells() -> None:
    sampler = small(dilation=0)
    sampler.grid.fill(MovingBall())
    unit = torch.rand(500, 5, generator=torch.Generator().manual_seed(0))
    positions, times = sampler.occupied_positions(unit)
    cells = (
        (positions - sampler.grid.box[0]) / (sampler.grid.box[1] - sampler.grid.box[0]) * sampler.grid.shape[1:]
    ).long()
    slabs = (times * sampler.grid.shape[0]).long()
    assert sampler.grid.occupied[(slabs, *cells.unbind(-1))].all()
    assert len(slabs.unique()) > 5


def test_rays_that_do_not_fit_have_no_samples() -> None:
    sampler = small().eval()
    sampler.grid.fill(MovingBall())
    rays = rays_towards_origin(200)
    samples = sampler.sample_fixed(rays, MovingBall(), Capacity(1 << 14, 50, 1e-3))
    assert samples.starts.shape == (50,)
    assert samples.wanted[0] < 1 << 14
    assert samples.wanted[1] > 50
    assert int((samples.lengths > 0).sum()) <= 50
    everything = sampler.sample_fixed(rays, MovingBall(), Capacity(1 << 14, 1 << 14, 1e-3))
    assert everything.is_placed.all()
    last = samples.ray_indices[samples.lengths > 0].max()
    assert samples.is_placed.sum() == last + 1
    is_same = (everything.ray_indices <= last) & (everything.lengths > 0)
    assert torch.equal(samples.starts[samples.lengths > 0], everything.starts[is_same])


def test_empty_places_are_neither_kept_nor_observed() -> None:
    """They lie at the rays' origins, where this fog is, too."""
    sampler = small(dilation=0).train()
    inside = torch.zeros_like(sampler.grid.occupied)
    inside[:, 6:10, 6:10, 6:10] = True
    sampler.grid.occupy(inside)
    before = sampler.grid.maxima.clone()
    samples = sampler.sample_fixed(rays_towards_origin(50), fog(5.0), Capacity(1 << 12, 1 << 12, 0.0))
    assert 0 < int(samples.wanted[0]) < 1 << 12
    assert int(samples.wanted[1]) == int(samples.wanted[0]) == int((samples.lengths > 0).sum())
    assert torch.equal(sampler.grid.maxima[~inside], before[~inside])
    assert sampler.grid.maxima[inside].max() == 5
