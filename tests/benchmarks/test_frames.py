"""The suite that times frames of finished models."""

from types import SimpleNamespace

import benchmark
import pytest
import torch
from omegaconf import OmegaConf

from benchmarks import Settings, run_suite
from dnerf.core.backgrounds import ConstantBackground
from dnerf.data import SyntheticData
from dnerf.evaluation import psnr
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import OccupancyGrid, OccupancySampler
from dnerf.scenes import SCENES

BOX = [[-1.5] * 3, [1.5] * 3]
OPTIONS = {
    "split": "test", "num_frames": 2, "scales": [1], "repeats": 1, "ways": {"whole intervals": ["subdivision=1"]},
}  # fmt: skip


def renderer(subdivision: int) -> Renderer:
    grid = OccupancyGrid(BOX, 16)
    sampler = OccupancySampler(grid, 0.3, render_subdivision=subdivision)
    return Renderer(SCENES["static"](), sampler, ConstantBackground("white"), stop_transmittance=1e-4).eval()


@pytest.fixture
def rows(tmp_path):
    """What the suite finds of a run with three parts of an interval, in which ways may change them."""
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "model.safetensors").write_bytes(bytes(1 << 19))
    data = SyntheticData(SCENES["static"](), resolution=16, num_train=1, num_val=1, num_test=3)

    def load(run, changes):
        assert run == str(tmp_path / "one")
        parts = int(changes[0].removeprefix("subdivision=")) if changes else 3
        return {"renderer": renderer(parts), "data": data, "chunk": 4096}

    def measure(**options):
        options = {**OPTIONS, "runs": [str(tmp_path / "one")], **options}
        result = run_suite("frames", Settings(load=load, options=options))
        assert all(row["median_ms"] > 0 and row["model_MiB"] == 0.5 for row in result.tables[0].rows)
        return list(result.tables[0].rows)

    return measure


def test_every_way_is_compared_with_the_truth_and_with_the_runs_own(rows):
    found = rows()
    assert [(row["run"], row["size"], row["way"]) for row in found] == [
        ("one", "16 x 16", "as trained"), ("one", "16 x 16", "whole intervals")
    ]  # fmt: skip
    assert found[0]["psnr"] > found[1]["psnr"] + 0.2  # shorter intervals are nearer to the truth
    assert found[0]["to_own"] is None
    assert found[1]["to_own"] > found[1]["psnr"]
    frames = SyntheticData(SCENES["static"](), resolution=16, num_train=1, num_val=1, num_test=3).frames("test")
    scores = [
        psnr(renderer(3).render_image(frames.camera(i), float(frames.times[i])).rgb, frames.image(i, torch.ones(3)))
        for i in (0, 2)
    ]
    assert found[0]["psnr"] == pytest.approx(sum(scores) / 2, abs=1e-4)


def test_images_of_another_size_are_timed_and_not_compared(rows):
    found = rows(scales=[1, 1.5], ways={})
    assert [(row["size"], row["psnr"] is None) for row in found] == [("16 x 16", False), ("24 x 24", True)]


def test_settings_must_read_runs():
    with pytest.raises(ValueError, match="load must be given"):
        run_suite("frames", Settings(options={**OPTIONS, "runs": ["runs/one"]}))


def test_ways_change_settings_that_a_run_has(monkeypatch):
    saved = {"renderer": {"sampler": {"render_subdivision": 3, "min_weight": None}}, "data": {}, "chunk": 7}
    monkeypatch.setattr(benchmark, "load_config", lambda run: OmegaConf.create(saved))
    monkeypatch.setattr(benchmark, "load_renderer", lambda run, config, device: config.renderer.sampler)
    monkeypatch.setattr(benchmark, "build", lambda config: SimpleNamespace(settle=lambda world: None))
    monkeypatch.setattr(benchmark, "load_scene", lambda run: SimpleNamespace(world=None))
    changes = ["renderer.sampler.render_subdivision=1", "renderer.sampler.min_weight=0.5"]
    assert benchmark._finished("one", changes)["renderer"] == {"render_subdivision": 1, "min_weight": 0.5}
    assert benchmark._finished("one", [])["renderer"] == saved["renderer"]["sampler"]
    with pytest.raises(ValueError, match=r"frames\.ways: one has no setting renderer\.sampler\.cuts"):
        benchmark._finished("one", ["renderer.sampler.cuts=1"])
