"""Steps of a fixed size: nothing in them waits for a device, and they learn what other steps learn."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from device_waits import DeviceWaits
from fixed_models import losses, small_renderer
from recorded_graphs import RecordedCache, recorded_graphs
from reference import occupancy_sampler
from small_runs import Watch, weights
from torch import Tensor, nn

from dnerf import kernels
from dnerf.core.backgrounds import RandomBackground
from dnerf.core.compositing import FieldOutput, Rendering
from dnerf.core.schedules import Ramp
from dnerf.data import Frames, SyntheticData
from dnerf.data.pixel_samplers import UniformPixels
from dnerf.fields import RadianceField
from dnerf.losses import Batch, Loss, PhotometricLoss
from dnerf.rendering import Renderer
from dnerf.rendering.cuda_graphs import GraphCache
from dnerf.samplers import Capacity
from dnerf.scenes import make_scene
from dnerf.training import AdamSettings, Checkpoints, Recovery, Run, Trainer
from dnerf.training.step import ERRORS, LOOK_EVERY, ROUND_TO, Stepper, next_num_rays

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
BOX = ((-9.0,) * 3, (9.0,) * 3)


@pytest.fixture(scope="module")
def frames() -> Frames:
    return SyntheticData(make_scene("walker"), 16, num_train=6).frames("train")


def recorded_on(device: str, *, replays: bool = True) -> AbstractContextManager[object]:
    """Where steps are replayed: on a GPU by CUDA, on the CPU by what is recorded."""
    return nullcontext() if device == "cuda" else recorded_graphs(replays=replays)


def stepper(
    renderer: Renderer, frames: Frames, *, cache: Any = None, places=(8192, 4096), terms: Any = None
) -> Stepper:
    device = renderer.device
    made = nn.ModuleDict(losses() if terms is None else terms).to(device)
    optimizer = AdamSettings({"default": 1e-3}, orthogonal=True).build(renderer)
    optimizer.make_capturable()
    generator = torch.Generator(device).manual_seed(0)
    run = Run(renderer.train(), frames.to(device), optimizer, generator, made, UniformPixels())
    graphs = None if cache is None else cache(device, [generator], list(renderer.parameters()))
    return Stepper(run, Capacity(*places), graphs)


def pixels(frames: Frames, count: int, seed: int, device: torch.device) -> Tensor:
    return torch.randint(frames.num_pixels, (count,), generator=torch.Generator().manual_seed(seed)).to(device)


@pytest.mark.parametrize("progress", [0.0, 1.0])
def test_a_step_waits_for_no_device(frames: Frames, progress: float) -> None:
    """All losses at once, forward, backward and optimiser, with the kernels that a GPU takes."""
    triton = pytest.importorskip("triton")
    if not (torch.cuda.is_available() or triton.knobs.runtime.interpret):
        pytest.skip("no GPU, and triton was imported before it could be told to interpret")
    renderer = small_renderer(device="cuda" if torch.cuda.is_available() else "cpu")
    renderer.set_progress(progress)  # of which the sampler's subdivision depends
    taken = stepper(renderer, frames, places=(128, 64))
    taken.run.step = 3  # the next one is the fourth, in which all terms have their turn
    with kernels.use_backend("triton"):
        indices = pixels(frames, 8, 0, renderer.device)
        taken(indices)
        with DeviceWaits() as waits:
            found = taken._optimize(indices, list(taken.losses))
    assert found.keys() == {*taken.losses, "loss", "mse", "opacity", "contrast", ERRORS}
    assert waits.found == []


def test_waits_are_noticed() -> None:
    values = torch.arange(4.0)
    with DeviceWaits() as waits:
        _ = float(values.sum()), values[values > 1].sum(), values.nonzero(), torch.tensor([1.0])
        torch.repeat_interleave(torch.tensor([1, 2]), output_size=3)
    assert set(waits.found) == {"_local_scalar_dense", "index", "nonzero", "lift_fresh"}


class Fog(RadianceField):
    """Opaque and of one colour, which can be learnt."""

    def __init__(self) -> None:
        super().__init__()
        self.color = nn.Parameter(torch.tensor([0.2, 0.5, 0.8]))

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return torch.full_like(times, 1e4)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), self.color.expand(positions.shape))


@pytest.mark.parametrize(("marched", "kept"), [(8192, 4096), (8192, 40), (300, 4096)])
def test_rays_without_places_are_not_taken_for_wrong_ones(marched: int, kept: int) -> None:
    """Images of opaque fog, as the model renders them: nothing is wrong, whether there is room or not."""
    images = SyntheticData(make_scene("walker"), 8, num_train=2).frames("train")
    color = torch.tensor([51, 127, 204, 255], dtype=torch.uint8).expand(2, 8, 8, 4)
    images = replace(images, images=color.contiguous())
    renderer = Renderer(Fog(), occupancy_sampler(BOX, 0.3, 8, min_weight=0.01))
    taken = stepper(renderer, images, places=(marched, kept), terms={"rgb": PhotometricLoss()})
    result = taken(torch.arange(128))
    is_known = result.errors >= 0
    assert bool(is_known.all()) == (marched + kept > 12000)
    assert is_known[:2].all()
    assert (result.errors[~is_known] == -1).all()
    assert result.errors[is_known].max() < 1e-4
    assert result.scalars["mse"] < 1e-4
    assert result.scalars["opacity"] > 0.99


def test_opacity_counts_in_errors_and_contrast_before_any_background() -> None:
    """Grey fog before grey: where images show nothing it looks right there, and wrong before other colours."""
    images = SyntheticData(make_scene("walker"), 8, num_train=2).frames("train")
    grey = torch.tensor([127, 127, 127, 255], dtype=torch.uint8).repeat(2, 8, 8, 1)
    grey[1] = 0
    renderer = Renderer(Fog(), occupancy_sampler(BOX, 0.3, 8, min_weight=0.01), RandomBackground())
    nn.init.constant_(renderer.field.color, 127 / 255)
    result = stepper(renderer, replace(images, images=grey), terms={"rgb": PhotometricLoss()})(torch.arange(128))
    expected = torch.tensor([0.0, 1 / 12]).repeat_interleave(64)
    torch.testing.assert_close(result.errors, expected, atol=1e-4, rtol=0)
    assert float(result.scalars["contrast"]) == pytest.approx(0.5 * (1 / 12) ** 0.5, abs=2e-3)


def test_fixed_places_teach_what_others_teach(frames: Frames) -> None:
    """The same gradients, where all that is wanted fits."""
    free, fixed = small_renderer().train(), small_renderer().train()
    indices = pixels(frames, 100, 1, torch.device("cpu"))
    for progress in (0.0, 1.0):
        for renderer, capacity in ((free, None), (fixed, Capacity(40000, 20000))):
            renderer.set_progress(progress)
            renderer.zero_grad()
            generator = torch.Generator().manual_seed(5)
            rendering = renderer(frames.pixels(indices)[0], generator=generator, capacity=capacity)
            rendering.rgb.square().sum().backward()
        assert rendering.samples.wanted is not None
        assert 0 < int(rendering.samples.wanted.max()) < 20000
        for (name, a), (_, b) in zip(free.named_parameters(), fixed.named_parameters(), strict=True):
            torch.testing.assert_close(a.grad, b.grad, rtol=2e-3, atol=1e-5 * float(a.grad.abs().max()), msg=name)
    seen, other = free.sampler.grid.maxima, fixed.sampler.grid.maxima
    torch.testing.assert_close(other[seen > 1e-2], seen[seen > 1e-2], rtol=0.2, atol=0)


@pytest.mark.parametrize("device", DEVICES)
def test_replayed_steps_are_steps(frames: Frames, device: str) -> None:
    models = [small_renderer(device=device), small_renderer(device=device)]
    found = []
    for model, cache in zip(models, (None, GraphCache if device == "cuda" else RecordedCache), strict=True):
        with recorded_on(device, replays=cache is not None):
            taken, terms = stepper(model, frames, cache=cache), []
            for number in range(40):
                taken.run.step, taken.run.progress = number, number / 40
                model.set_progress(number / 40)
                taken.run.optimizer.set_rates(1.0)
                taken.update()
                result = taken(pixels(frames, 256, number, model.device))
                terms.append({name: float(value) for name, value in result.scalars.items()})
            found.append(terms)
    assert [terms.keys() for terms in found[0]] == [terms.keys() for terms in found[1]]
    # Sums by atomic additions come in any order.
    for a, b in zip(*found, strict=True):
        assert a["mse"] == pytest.approx(b["mse"], rel=2e-2)
    difference = (weights(models[0]) - weights(models[1])).norm()
    assert difference < 0.2 * (weights(models[0]) - weights(small_renderer())).norm()


def spoiling(spoilt: int, stop: int = -1) -> Watch:
    """Breaks the model after a step, or the process."""

    def work(run: Run) -> None:
        if run.step == stop:
            raise KeyboardInterrupt
        if run.step == spoilt:
            run.renderer.field.deformation.mlp.output.weight.data.fill_(torch.nan)

    return Watch(work)


def fixed_trainer(records: Watch, **changes: Any) -> Trainer:
    callbacks = {"recovery": Recovery(keep_every=20), "records": records, **changes.pop("callbacks", {})}
    settings = {"num_rays": 256, "target_samples": 4096, "graphs": True, "losses": losses(), "log_every": 20}
    return Trainer(optimizer=AdamSettings({"default": 1e-2}), callbacks=callbacks, **(settings | changes))


@pytest.mark.parametrize("device", DEVICES)
def test_replayed_training_learns_and_is_brought_back(frames: Frames, device: str) -> None:
    renderer, records = small_renderer(device=device), spoiling(50)
    with recorded_on(device):
        fixed_trainer(records, num_steps=300 if device == "cuda" else 120).fit(renderer, frames)
    seen = records.records
    assert seen[-1].losses["rgb"] < (0.3 if device == "cuda" else 0.6) * seen[0].losses["rgb"]
    assert 60 not in [record.step for record in seen]  # taken back
    assert all(0.3 * 4096 < record.num_samples < 1.5 * 4096 for record in seen[3:])


def test_replays_are_the_work_itself_bit_for_bit_after_a_rollback_and_a_stop_too(
    frames: Frames, tmp_path: Path
) -> None:
    def trained(folder: str, stop: int = -1, *, replays: bool = True) -> Renderer:
        renderer, callbacks = small_renderer(), {"checkpoints": Checkpoints(20)}
        made = fixed_trainer(spoiling(24, stop), num_steps=60, log_every=4, callbacks=callbacks)
        with recorded_graphs(replays=replays):
            made.fit(renderer, frames, folder=tmp_path / folder, resume=True)
        assert made.callbacks["recovery"].rollbacks == 1
        return renderer

    with pytest.raises(KeyboardInterrupt):
        trained("broken", stop=44)
    whole = weights(trained("whole"))
    assert torch.equal(weights(trained("broken")), whole)
    assert torch.equal(weights(trained("anew", replays=False)), whole)


def test_the_weight_of_a_term_follows_its_schedule_in_replays_too(frames: Frames) -> None:
    for cache in (None, GraphCache, RecordedCache):
        terms = {"rgb": PhotometricLoss(weight=Ramp(1.0, 3.0))}
        with recorded_graphs():
            taken = stepper(small_renderer(), frames, cache=cache, terms=terms)
            for number in range(5):
                taken.run.step, taken.run.progress = number, number / 4
                scalars = taken(pixels(frames, 64, number, torch.device("cpu"))).scalars
                assert float(scalars["loss"]) == pytest.approx((1 + number / 2) * float(scalars["rgb"]), rel=1e-6)


@pytest.mark.gpu
def test_the_clock_waits_for_the_device(frames: Frames) -> None:
    """Records are made outside of the clock, but what a step left to the device is training."""

    class Slow(Loss):
        def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
            torch.cuda._sleep(200_000_000)
            return (rendering.rgb - batch.target).square().mean()

    ends = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
    ends[0].record()
    torch.cuda._sleep(200_000_000)
    ends[1].record()
    torch.cuda.synchronize()
    trainer = Trainer(num_steps=5, num_rays=64, losses={"slow": Slow()}, log_every=1)
    record = trainer.fit(small_renderer(device="cuda"), frames)
    assert record.seconds > 0.8 * 5e-3 * ends[0].elapsed_time(ends[1])


def following(num_rays: int, fullness: float, most: int, step: int = LOOK_EVERY) -> int:
    """Rays after a step that filled that share of 1000 fixed places."""
    return next_num_rays(num_rays, round(1000 * fullness), 1000, most, step, is_fixed=True)


def test_rays_follow_how_full_places_are_within_bounds() -> None:
    wanted = {0.9: 5000, 0.8: 5000, 0.4: 11008, 0.1: 19968, 1.5: 2816, 9.0: 1024, 0.0: 19968}
    assert {fullness: following(5000, fullness, 1 << 20) for fullness in wanted} == wanted
    assert following(5000, 0.4, 1 << 20, step=LOOK_EVERY - 1) == 5000  # it is not always known how full they are
    assert following(5000, 0.1, 6000) == 6000 // ROUND_TO * ROUND_TO
    assert following(300, 5.0, 6000) == 64  # below what is rounded to, powers of two
    assert following(64, 0.1, 100) == following(100, 1.2, 100) == 64
    assert following(1, 9.0, 100) == 1


@pytest.mark.parametrize(
    ("num_rays", "num_samples", "expected"),
    [(100, 2000, 50), (100, 800, 125), (100, 10, 200), (200, 10, 300), (100, 10**9, 50), (100, 0, 200)],
)
def test_rays_adapt_to_the_wanted_samples_by_a_factor_of_two_at_most(num_rays, num_samples, expected) -> None:
    assert next_num_rays(num_rays, num_samples, 1000, 300, 7, is_fixed=False) == expected


def test_padding_does_not_pass_for_samples(frames: Frames) -> None:
    # Padded to more than is wanted: counted, it would leave one ray.
    renderer, records = small_renderer(pad_to=4096), Watch()
    made = Trainer(num_steps=40, num_rays=64, target_samples=1024, log_every=1, callbacks={"records": records})
    made.fit(renderer, frames)
    late = records.records[20:]
    assert 0.5 < sum(record.num_samples for record in late) / len(late) / 1024 < 1.5
    assert min(record.num_rays for record in late) > 8
