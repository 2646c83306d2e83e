"""What is put through the suite: exact scenes, models trained on them for seconds, and fields broken on purpose."""

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from dnerf.backgrounds import RandomBackground
from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.compositing import FieldOutput
from dnerf.data import SyntheticData
from dnerf.deformations import Deformation, DisplacementDeformation
from dnerf.fields import DeformedField, GridField
from dnerf.fields.base import RadianceField
from dnerf.rays import Rays, Samples
from dnerf.renderer import Renderer
from dnerf.samplers import OccupancySampler, Sampler, StratifiedSampler
from dnerf.scenes import AnalyticScene, make_scene, make_thin_rod
from dnerf.training import Trainer

BOX = ((-1.35, -1.35, -1.0), (1.35, 1.35, 1.0))
NUM_SLABS = 8
TRAIN_FRAMES = 40
BATCH = 2048
REACH = 0.5


class ExactSampler(Sampler):
    """Asks the scene itself, whatever wraps it."""

    def __init__(self, scene) -> None:
        super().__init__()
        self.scene = scene

    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        return self.scene.exact_samples(rays)


def suite_scene(name: str) -> AnalyticScene:
    """A scene by name; the thin rod is forty times as thick, as opaque as it was.

    The real one shows in none of the suite's rays and holds none of the points that pairs are fitted to: whatever is
    asked of it would be asked of its hub alone.
    """
    return make_thin_rod(radius=0.04, density=100.0) if name == "thin_rod" else make_scene(name)


def exact(name: str) -> Renderer:
    """The exact pictures of a scene."""
    scene = suite_scene(name)
    return Renderer(scene, ExactSampler(scene))


def camera_rays(size: int = 10) -> Rays:
    """Rays of a small picture, in double precision so that tiny steps of time are what they say."""
    camera = Camera(Intrinsics.from_angle(size, size, 0.6), look_at((3.5, 0.6, 1.7)))
    return camera.rays(0.0)


# A pair is a function that makes a deformation and a canonical field. One line puts another through the suite.
Pair = Callable[[], tuple[Deformation, RadianceField]]
PAIRS: dict[str, Pair] = {
    "displacement": lambda: (
        DisplacementDeformation(3, 48, (), position_frequencies=3, time_frequencies=4, canonical_time=0.0),
        GridField(BOX, (16, 32, 64), 4, max_rows=1 << 16, hidden_features=32, num_layers=1),
    ),
}


def training_points(scene: AnalyticScene, count: int = 1 << 16) -> Tensor:
    """Random points at training times, as many in matter as near and far from it: position, time, hidden share, rgb."""
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(BOX)
    positions = torch.lerp(low, high, torch.rand(count, 3, generator=generator))
    times = torch.linspace(0, 1, TRAIN_FRAMES)[torch.randint(TRAIN_FRAMES, (count,), generator=generator)]
    truth = scene(positions, torch.nn.functional.normalize(-positions, dim=-1), times)
    hidden = 1 - torch.exp(-REACH * truth.density)
    rows = torch.cat([positions, times[:, None], hidden[:, None], truth.rgb], dim=-1)
    inside, outside = rows[hidden > 0], rows[hidden == 0]
    copies = max(1, len(outside) // (3 * len(inside)))
    return torch.cat([inside.repeat(copies, 1), outside])


@cache
def fitted(pair: str, scene_name: str, num_steps: int = 80) -> Renderer:
    """A pair fitted to an exact scene: seeded regression on density and colour at random points and times.

    A second of it gives a pair that moves in earnest, though roughly: enough for the checks that ask how it moves
    rather than whether it is right. Densities are compared by what they hide over half a unit.
    """
    torch.manual_seed(0)
    deformation, canonical = PAIRS[pair]()
    field, scene = DeformedField(deformation, canonical), suite_scene(scene_name)
    points = training_points(scene)
    groups = [{"params": deformation.parameters(), "lr": 6e-3}, {"params": canonical.parameters(), "lr": 2e-2}]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.05 ** (1 / num_steps))
    generator = torch.Generator().manual_seed(0)
    for _ in range(num_steps):
        chosen = torch.randint(len(points), (BATCH,), generator=generator)
        positions, times, true_hidden, true_rgb = points[chosen].split([3, 1, 1, 3], dim=-1)
        output = field(positions, torch.zeros_like(positions), times[:, 0])
        hidden = 1 - torch.exp(-REACH * output.density)
        color_error = (true_hidden * (output.rgb - true_rgb).square()).mean()
        loss = (hidden - true_hidden[:, 0]).square().mean() + color_error
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    renderer = Renderer(field.requires_grad_(False), StratifiedSampler(48, BOX))
    return renderer.eval()


@cache
def trained(pair: str, scene_name: str, num_steps: int = 500) -> Renderer:
    """A pair trained on exact pictures as a user would, some 20 seconds: for checks that ask whether it is right."""
    torch.manual_seed(0)
    deformation, canonical = PAIRS[pair]()
    sampler = OccupancySampler(BOX, 0.04, 32, num_slabs=NUM_SLABS, num_probes=1 << 15, decay=0.6)
    renderer = Renderer(DeformedField(deformation, canonical), sampler, RandomBackground())
    frames = SyntheticData(suite_scene(scene_name), 64, num_train=TRAIN_FRAMES).frames("train")
    trainer = Trainer(
        num_steps=num_steps,
        num_rays=512,
        target_samples=12288,
        learning_rates={"": 2e-2, "field.deformation": 6e-3, "field.canonical.head": 5e-3},
        betas=(0.9, 0.99),
        epsilon=1e-15,
        warmup_steps=20,
        final_learning_rate=0.05,
        progress_bar=False,
    )
    trainer.fit(renderer, frames, seed=0)
    return renderer


def with_occupancy(renderer: Renderer) -> Renderer:
    """The same field behind a sampler that divides time into slabs."""
    sampler = OccupancySampler(BOX, 0.05, 32, num_slabs=NUM_SLABS)
    sampler.fill(renderer.field, 4)
    return Renderer(renderer.field, sampler).eval()


class Retimed(RadianceField):
    """A field seen at other times than it is asked for."""

    def __init__(self, field: RadianceField, clock: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.field, self.clock = field, clock

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.field.density(positions, self.clock(times))

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return self.field(positions, directions, self.clock(times))


class Tinted(RadianceField):
    """A field whose colours are multiplied by a function of time."""

    def __init__(self, field: RadianceField, tint: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.field, self.tint = field, tint

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.field.density(positions, times)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        output = self.field(positions, directions, times)
        return FieldOutput(output.density, output.rgb * self.tint(times)[..., None], output.extras)


class Shifted(Deformation):
    """A deformation with something added."""

    def __init__(self, deformation: Deformation, shift: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.deformation, self.shift = deformation, shift

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        canonical = self.deformation(positions, times)
        return canonical + self.shift(times)[..., None] * torch.tensor([0.0, 1.0, 0.0]).to(canonical)


def eight_steps(times: Tensor) -> Tensor:
    """Time quantised to 8 steps."""
    return (8 * times).floor().clamp(max=7) / 8


def flicker(times: Tensor) -> Tensor:
    """A lamp that goes up and down by 10 % at once, 37 times."""
    return 0.9 + 0.1 * torch.sign(torch.sin(2 * torch.pi * 37 * times))


def fade(times: Tensor) -> Tensor:
    """Colours that fade slowly and smoothly."""
    return 1 - 0.3 * times


def jump(times: Tensor) -> Tensor:
    """Everything is shifted by 0.15 units from t = 0.53 on."""
    return 0.15 * (times > 0.53).to(times)
