"""The suite that times frames of finished models."""

import pytest
import torch

from dnerf.backgrounds import ConstantBackground
from dnerf.benchmarks import Settings, run_suite
from dnerf.data import SyntheticData
from dnerf.deformations import DisplacementDeformation, FrameLattice
from dnerf.fields import Baking, DeformedField, GridField
from dnerf.metrics import psnr
from dnerf.renderer import Renderer
from dnerf.samplers import OccupancySampler, StratifiedSampler
from dnerf.scenes import SCENES

BOX = [[-1.5] * 3, [1.5] * 3]
OPTIONS = {"runs": ["runs/one"], "split": "test", "num_frames": 2, "scales": [1], "splits": [3, 1], "repeats": 1}


def rows(renderer: Renderer, **options: object) -> list[dict]:
    data = SyntheticData(SCENES["static"](), resolution=16, num_train=1, num_val=1, num_test=3)
    parts = {"renderer": renderer, "data": data, "chunk": 4096}
    result = run_suite("frames", Settings(load=lambda run: parts, options={**OPTIONS, **options}))
    assert all(row["median_ms"] > 0 for row in result.tables[0].rows)
    assert {row["run"] for row in result.tables[0].rows} == {"one"}
    return list(result.tables[0].rows)


def test_exact_matter_is_nearer_to_the_truth_in_shorter_steps() -> None:
    scene = SCENES["static"]()
    sampler = OccupancySampler(BOX, 0.3, 16, splits=3, min_weight=0)
    sampler.occupy(torch.tensor(True))
    found = rows(Renderer(scene, sampler, ConstantBackground("white"), stop_transmittance=1e-4))
    assert [(row["shown"], row["splits"]) for row in found] == [("one frame", 3), ("one frame", 1)]
    assert found[0]["psnr"] > found[1]["psnr"] + 0.2


def test_what_frames_share_shows_the_same_and_scores_are_those_of_frames() -> None:
    torch.manual_seed(0)
    canonical = GridField(BOX, (4, 8), 4, hidden_features=16, density_shift=1.0)
    deformation = DisplacementDeformation(2, 16, (), position_frequencies=2, time_frequencies=2)
    field = DeformedField(deformation, canonical, frame_lattice=FrameLattice(BOX, 24), baking=Baking(BOX, 128))
    sampler = OccupancySampler(BOX, 0.06, 16, num_slabs=2, margin=0)
    mask = torch.zeros(16, 16, 16, dtype=torch.bool)
    mask[6:10, 6:10, 6:10] = True
    sampler.occupy(mask)
    renderer = Renderer(field, sampler, ConstantBackground("white"), stop_transmittance=1e-4).eval()
    found = rows(renderer)
    assert [(row["shown"], row["splits"]) for row in found] == [
        ("one frame", 1), ("one frame", 3), ("in a sequence", 1), ("in a sequence", 3)
    ]  # fmt: skip
    assert found[2]["psnr"] == pytest.approx(found[0]["psnr"], abs=0.05)
    frames = SyntheticData(SCENES["static"](), resolution=16, num_train=1, num_val=1, num_test=3).frames("test")
    scores = [
        psnr(renderer.render_image(frames.camera(i), float(frames.times[i])).rgb, frames.image(i, torch.ones(3)))
        for i in (0, 2)
    ]
    assert found[0]["psnr"] == pytest.approx(sum(scores) / 2, abs=1e-4)


def test_other_samplers_have_one_way_and_settings_must_read_runs() -> None:
    found = rows(Renderer(SCENES["static"](), StratifiedSampler(16)))
    assert [(row["shown"], row["splits"]) for row in found] == [("one frame", None)]
    with pytest.raises(ValueError, match="load must be given"):
        run_suite("frames", Settings(options=OPTIONS))


def test_pictures_of_another_size_are_timed_and_not_compared() -> None:
    found = rows(Renderer(SCENES["static"](), StratifiedSampler(16)), scales=[1, 1.5])
    assert [(row["size"], row["psnr"] is None) for row in found] == [("16 x 16", False), ("24 x 24", True)]


def test_every_size_is_shown_in_the_runs_own_steps_first() -> None:
    scene = SCENES["static"]()
    sampler = OccupancySampler(BOX, 0.3, 16, splits=2, min_weight=0)
    sampler.occupy(torch.tensor(True))
    found = rows(Renderer(scene, sampler, stop_transmittance=1e-4), scales=[1, 1.5], splits=[1])
    assert [(row["size"], row["splits"]) for row in found] == [
        ("16 x 16", 2), ("16 x 16", 1), ("24 x 24", 2), ("24 x 24", 1)
    ]  # fmt: skip
    assert sampler.render_splits == 2
