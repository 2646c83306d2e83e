"""Steps of a fixed size: nothing in them waits for a device, and they learn what other steps learn."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from device_waits import DeviceWaits
from fixed_models import LOSSES, losses, small_renderer
from recorded_graphs import RecordedCache, recorded_graphs

from dnerf import kernels
from dnerf.compositing import FieldOutput, Rendering
from dnerf.data import Frames, SyntheticData
from dnerf.fields import RadianceField
from dnerf.graphs import GraphCache
from dnerf.losses import Loss
from dnerf.records import Callback, TrainingRecord
from dnerf.renderer import Renderer
from dnerf.run_state import CheckpointFolder
from dnerf.samplers import OccupancySampler, StratifiedSampler
from dnerf.scenes import make_scene
from dnerf.steps import LOOK_EVERY, ROUND_TO, Steps, next_num_rays, rays_that_fit
from dnerf.training import Trainer


@pytest.fixture(scope="module")
def frames() -> Frames:
    return SyntheticData(make_scene("walker"), 16, num_train=6).frames("train")


DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def recorded_on(device: str, *, replays: bool = True) -> AbstractContextManager[object]:
    """Where steps are replayed: on a GPU by CUDA, on the CPU by what is recorded."""
    return nullcontext() if device == "cuda" else recorded_graphs(replays=replays)


def steps(
    renderer: Renderer, frames: Frames, seed: int = 0, *, cache: type[GraphCache] | None = None, fixed: int = 4096
) -> Steps:
    device = renderer.device
    trainer = Trainer(learning_rates={"": 1e-3}, orthogonal=["field.deformation"])
    optimizer = trainer.optimizer(renderer)
    generator = torch.Generator(device).manual_seed(seed)
    renderer.train()
    renderer.sampler.fix_sizes(2 * fixed, fixed)
    optimizer.make_capturable()
    graphs = None if cache is None else cache(device, [generator], list(renderer.parameters()))
    every = {"elastic": 2, "steady": 4, "hidden_matter": 4}
    return Steps(
        renderer, renderer, frames.to(device), optimizer, generator, losses=losses(), loss_every=every, shows=True,
        lacks=True, fixed=fixed, graphs=graphs,
    )  # fmt: skip


def pixels(frames: Frames, count: int, seed: int, device: torch.device) -> torch.Tensor:
    return torch.randint(frames.num_pixels, (count,), generator=torch.Generator().manual_seed(seed)).to(device)


def weights(renderer: Renderer) -> torch.Tensor:
    return torch.cat([p.detach().flatten().cpu() for p in renderer.parameters()])


@pytest.mark.parametrize("splits", [1, 2])
def test_a_step_waits_for_no_device(frames: Frames, splits: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """All losses at once, forward, backward and optimiser, with the kernels that a GPU takes."""
    triton = pytest.importorskip("triton")
    if not (torch.cuda.is_available() or triton.knobs.runtime.interpret):
        pytest.skip("no GPU, and triton was imported before it could be told to interpret")
    renderer = small_renderer(device="cuda" if torch.cuda.is_available() else "cpu")
    renderer.sampler.set_progress(1.0 if splits == 2 else 0.0)
    taken = steps(renderer, frames, fixed=64)
    with kernels.use_backend("triton"):
        indices = pixels(frames, 8, 0, renderer.device)
        taken(indices, 4, 1.0, nullcontext)
        with DeviceWaits() as waits:
            terms = taken._optimize(indices, list(LOSSES), 1.0, len(indices))
    assert terms.keys() >= set(LOSSES)
    assert waits.found == []


class Fog(RadianceField):
    """Opaque and of one colour, which can be learnt."""

    def __init__(self) -> None:
        super().__init__()
        self.color = torch.nn.Parameter(torch.tensor([0.2, 0.5, 0.8]))

    def density(self, positions: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
        return torch.full_like(times, 1e4)

    def forward(self, positions: torch.Tensor, directions: torch.Tensor, times: torch.Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), self.color.expand(positions.shape))


@pytest.mark.parametrize(("marched", "fixed"), [(8192, 4096), (8192, 40), (300, 4096)])
def test_rays_without_places_are_not_taken_for_wrong_ones(marched: int, fixed: int) -> None:
    """Pictures of opaque fog, which the model shows: nothing is wrong or lacking, whether there is room or not."""
    pictures = SyntheticData(make_scene("walker"), 8, num_train=2).frames("train")
    image = torch.tensor([51, 127, 204, 255], dtype=torch.uint8).expand(2, 8, 8, 4)
    pictures = replace(pictures, images=image.contiguous())
    renderer = Renderer(Fog(), OccupancySampler(((-9.0,) * 3, (9.0,) * 3), 0.3, 8, min_weight=0.01))
    taken = steps(renderer, pictures, fixed=fixed)
    taken.losses = {"rgb": losses()["rgb"]}
    renderer.sampler.fix_sizes(marched, fixed)
    found, errors, _ = taken(torch.arange(128), 1, 1.0, nullcontext)
    is_known = errors >= 0
    assert bool(is_known.all()) == (marched + fixed > 12000)
    assert is_known[:2].all()
    assert (errors[~is_known] == -1).all()
    assert errors[is_known].max() < 1e-4
    assert found["mse"] < 1e-4
    assert found["needed opacity"] > 0.01
    assert found["lacking opacity"] == 0
    assert found["mean opacity"] > 0.99


def test_an_update_waits_for_no_device(frames: Frames) -> None:
    renderer = small_renderer()
    probes = renderer.sampler.probes(16)
    assert probes is not None
    with kernels.use_backend("reference"), DeviceWaits() as waits:
        renderer.field.density(
            *(x.float() for x in (probes[:, :3], probes[:, 3]))
        )  # the grid's definition makes tensors of its levels
        known = list(waits.found)
        renderer.learn(probes)
    assert waits.found == known * 2


def test_waits_are_noticed() -> None:
    values = torch.arange(4.0)
    with DeviceWaits() as waits:
        float(values.sum())
        values[values > 1].sum()
        values.nonzero()
        torch.tensor([1.0])
        torch.repeat_interleave(torch.tensor([1, 2]), output_size=3)
    assert set(waits.found) == {"_local_scalar_dense", "index", "nonzero", "lift_fresh"}


def test_fixed_places_teach_what_others_teach(frames: Frames) -> None:
    """The same gradients, where all that is wanted fits."""
    free, fixed = small_renderer(filter_joins=1).train(), small_renderer().train()
    fixed.sampler.fix_sizes(40000, 20000)
    indices = pixels(frames, 100, 1, torch.device("cpu"))
    for progress in (0.0, 1.0):
        for renderer in (free, fixed):
            renderer.sampler.set_progress(progress)
            renderer.zero_grad()
            rendering = renderer(frames.pixels(indices)[0], generator=torch.Generator().manual_seed(5))
            rendering.rgb.square().sum().backward()
        assert 0 < fixed.sampler.fullness() < 1
        for (name, a), (_, b) in zip(free.named_parameters(), fixed.named_parameters(), strict=True):
            torch.testing.assert_close(a.grad, b.grad, rtol=2e-3, atol=1e-5 * float(a.grad.abs().max()), msg=name)
    seen, unseen = free.sampler.get_buffer("maxima"), fixed.sampler.get_buffer("maxima")
    torch.testing.assert_close(unseen[seen > 1e-2], seen[seen > 1e-2], rtol=0.2, atol=0)


def test_graphs_on_a_cpu_are_the_work_itself(frames: Frames) -> None:
    models = [small_renderer(), small_renderer()]
    for model, cache in zip(models, (None, GraphCache), strict=True):
        taken = steps(model, frames, cache=cache)
        for number in range(1, 6):
            taken(pixels(frames, 64, number, torch.device("cpu")), number, 1.0, nullcontext)
            taken.update(16 * number)
    assert torch.equal(weights(models[0]), weights(models[1]))


@pytest.mark.parametrize(
    ("fullness", "rays"), [(0.9, 5000), (0.8, 5000), (0.4, 11008), (0.1, 19968), (1.5, 2816), (9.0, 1024), (0.0, 19968)]
)
def test_rays_follow_how_full_places_are(fullness: float, rays: int) -> None:
    assert rays_that_fit(5000, fullness, 1 << 20) == rays


def test_rays_have_bounds() -> None:
    assert rays_that_fit(5000, 0.1, 6000) == 6000 // ROUND_TO * ROUND_TO
    assert rays_that_fit(300, 5.0, 6000) == 64  # below what is rounded to, powers of two
    assert rays_that_fit(100, 1.2, 100) == 64
    assert rays_that_fit(64, 0.1, 100) == 64
    assert rays_that_fit(1, 9.0, 100) == 1


def test_training_with_fixed_places_learns(frames: Frames) -> None:
    renderer, seen = small_renderer(), []
    trainer = Trainer(
        num_steps=128, num_rays=256, target_samples=16384, graphs=True, learning_rates={"": 1e-2}, losses=losses(),
        progress_bar=False, log_every=16,
    )  # fmt: skip
    trainer.fit(renderer, frames, callbacks=[lambda record, _: seen.append(record)])
    assert seen[-1].losses["rgb"] < 0.7 * seen[0].losses["rgb"]
    assert {record.num_rays % ROUND_TO for record in seen} == {0}
    assert all(0.3 * 16384 < record.num_samples < 1.3 * 16384 for record in seen[4:])
    assert renderer.sampler.settings[0] is None


def test_training_with_fixed_places_is_continued_bit_for_bit(frames: Frames, tmp_path: Path) -> None:
    def broken(record: TrainingRecord, _: Renderer) -> None:
        if record.step == 44:
            raise KeyboardInterrupt

    def trained(folder: str, *callbacks: Callback) -> Renderer:
        renderer = small_renderer()
        trainer = Trainer(
            num_steps=60, num_rays=256, target_samples=8192, graphs=True, losses=losses(), progress_bar=False,
            loss_every={"steady": 3}, log_every=4, checkpoint_every=20,
        )  # fmt: skip
        checkpoints = CheckpointFolder(tmp_path / folder)
        trainer.fit(renderer, frames, callbacks=callbacks, checkpoints=checkpoints, resume=True)
        return renderer

    with pytest.raises(KeyboardInterrupt):
        trained("broken", broken)
    assert torch.equal(weights(trained("broken")), weights(trained("whole")))


def test_what_has_no_fixed_size_is_refused(frames: Frames) -> None:
    with pytest.raises(ValueError, match="target_samples must be given with graphs"):
        Trainer(graphs=True)
    renderer = small_renderer()
    renderer.sampler = StratifiedSampler(8)
    with pytest.raises(ValueError, match="StratifiedSampler cannot place samples in a fixed number of places"):
        Trainer(graphs=True, target_samples=100, num_steps=1).fit(renderer, frames)


@pytest.mark.parametrize("device", DEVICES)
def test_replayed_steps_are_steps(frames: Frames, device: str) -> None:
    models = [small_renderer(device=device), small_renderer(device=device)]
    found = []
    for model, cache in zip(models, (None, GraphCache if device == "cuda" else RecordedCache), strict=True):
        with recorded_on(device, replays=cache is not None):
            taken = steps(model, frames, cache=cache)
            terms = []
            for number in range(1, 41):
                taken.renderer.set_progress(number / 40)
                taken.optimizer.set_rates(1.0)
                scalars, _, _ = taken(pixels(frames, 256, number, model.device), number, 1.0, nullcontext)
                terms.append({name: float(value) for name, value in scalars.items()})
                taken.update(number)
            found.append(terms)
    assert [terms.keys() for terms in found[0]] == [terms.keys() for terms in found[1]]
    # Sums by atomic additions come in any order.
    for a, b in zip(*found, strict=True):
        assert a["mse"] == pytest.approx(b["mse"], rel=2e-2)
    difference = (weights(models[0]) - weights(models[1])).norm()
    start = weights(small_renderer())
    assert difference < 0.2 * (weights(models[0]) - start).norm()


@pytest.mark.parametrize("device", DEVICES)
def test_replayed_training_learns(frames: Frames, device: str) -> None:
    renderer = small_renderer(device=device)
    trainer = Trainer(
        num_steps=300 if device == "cuda" else 100, num_rays=256, target_samples=4096, graphs=True,
        learning_rates={"": 1e-2}, losses=losses(), progress_bar=False, log_every=20,
        loss_every={"elastic": 2, "steady": 4, "hidden_matter": 4},
    )  # fmt: skip
    seen = []
    with recorded_on(device):
        trainer.fit(renderer, frames, callbacks=[lambda record, _: seen.append(record)])
    assert seen[-1].losses["rgb"] < (0.3 if device == "cuda" else 0.6) * seen[0].losses["rgb"]


@pytest.mark.gpu
def test_the_clock_waits_for_the_device(frames: Frames) -> None:
    """Records are made outside of the clock, but what a step left to the device is training."""

    class Slow(Loss):
        def forward(self, rendering: Rendering, target: torch.Tensor, renderer: Renderer) -> torch.Tensor:
            torch.cuda._sleep(200_000_000)
            return (rendering.rgb - target).square().mean()

    ends = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
    ends[0].record()
    torch.cuda._sleep(200_000_000)
    ends[1].record()
    torch.cuda.synchronize()
    trainer = Trainer(num_steps=5, num_rays=64, losses={"slow": Slow()}, log_every=1, progress_bar=False)
    record = trainer.fit(small_renderer(device="cuda"), frames)
    assert record.seconds > 0.8 * 5e-3 * ends[0].elapsed_time(ends[1])


@pytest.mark.parametrize(
    ("num_rays", "num_samples", "expected"),
    [(100, 2000, 50), (100, 800, 125), (100, 10, 200), (200, 10, 300), (100, 10**9, 50), (100, 0, 200)],
)
def test_rays_adapt_to_the_wanted_samples_by_a_factor_of_two_at_most(num_rays, num_samples, expected):
    assert next_num_rays(num_rays, num_samples, 1000, 300, is_fixed=False, step=7) == expected


def test_padding_does_not_pass_for_samples(frames: Frames) -> None:
    renderer = small_renderer()
    renderer.sampler.pad_to = 4096  # more than is wanted: counted, it would leave one ray
    seen: list[TrainingRecord] = []
    trainer = Trainer(num_steps=40, num_rays=64, target_samples=1024, log_every=1, progress_bar=False)
    trainer.fit(renderer, frames, callbacks=[lambda record, _: seen.append(record)])
    late = seen[20:]
    assert 0.5 < sum(record.num_samples for record in late) / len(late) / 1024 < 1.5
    assert min(record.num_rays for record in late) > 8


def test_with_fixed_places_rays_change_only_when_it_is_known_how_full_they_are():
    unknown, known = (
        next_num_rays(5000, 400, 1000, 1 << 20, is_fixed=True, step=step) for step in (LOOK_EVERY - 1, LOOK_EVERY)
    )
    assert unknown == 5000
    assert known == rays_that_fit(5000, 0.4, 1 << 20) != 5000
