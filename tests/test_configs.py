"""Every config composes, instantiates and takes a step."""

from functools import cache
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import DictConfig

from dnerf.data import SyntheticData
from dnerf.error_map import ErrorMap
from dnerf.scenes import make_scene

CONF = Path(__file__).parents[1] / "conf"
TINY = [
    "data.resolution=16",
    "data.num_train=2",
    "data.num_val=1",
    "data.num_test=1",
    "trainer.num_steps=2",
    "trainer.num_rays=8",
    "trainer.progress_bar=false",
]


def names(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@cache
def composed(*overrides: str) -> DictConfig:
    """A training's config; the same one for the same overrides, so leave it as it is."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train", [*overrides, *TINY])


CHOICES = [
    f"{group}={name}"
    for group in ("deformation", "field", "sampler", "background", "trainer", "scene", "experiment")
    for name in names(group)
]


@pytest.mark.parametrize("choice", CHOICES)
def test_config_composes_instantiates_and_takes_a_step(choice):
    config = composed(choice)
    data = instantiate(config.data, _convert_="all")
    renderer = instantiate(config.renderer, _convert_="all")
    trainer = instantiate(config.trainer, _convert_="all")
    before = [p.detach().clone() for p in renderer.parameters()]
    record = trainer.fit(renderer, data.frames("train"))
    assert record.step == 2
    assert any(not torch.equal(a, b) for a, b in zip(before, renderer.parameters()))


@pytest.mark.parametrize("loss", names("trainer/losses"))
def test_motion_losses_join_the_flow(loss):
    config = composed("experiment=flow", f"+trainer/losses={loss}", "data.train_end=0.8")
    data = instantiate(config.data, _convert_="all")
    trainer = instantiate(config.trainer, _convert_="all")
    own = {
        "rgb",
        "elastic",
        "hidden_matter",
        "smooth_knots",
        "smooth_volumes",
        "steady",
        "steady_opacity",
        "volume",
        "folding",
    }
    assert set(trainer.losses) == own | {loss}
    trainer.loss_every = {}  # every term in both steps
    terms = []
    renderer = instantiate(config.renderer, _convert_="all")
    trainer.fit(renderer, data.frames("train"), callbacks=[lambda record, _: terms.append(record.losses)])
    assert set(terms[-1]) == {"loss", *trainer.losses}


@pytest.mark.parametrize(("experiment", "slower"), [("fast", 4), ("flow", 8)])
def test_the_networks_that_move_matter_take_orthogonalised_steps(experiment, slower):
    """A prefix that matches nothing is no error, so a renamed module would go unnoticed."""
    config = composed(f"experiment={experiment}")
    renderer = instantiate(config.renderer, _convert_="all")
    optimizer = instantiate(config.trainer, _convert_="all").optimizer(renderer)
    names = {id(p): name for name, p in renderer.named_parameters()}
    matrices = [names[id(p)] for group in optimizer.param_groups if group["orthogonal"] for p in group["params"]]
    assert len(matrices) >= 3
    assert all(name.startswith("field.deformation.") for name in matrices)
    rates = {names[id(p)]: group["lr"] for group in optimizer.param_groups for p in group["params"]}
    ends = {name for name, rate in rates.items() if rate == rates[matrices[0]] / slower}
    assert ends == {name for name in rates if ".mlp.output." in name and "deformation" in name}
    assert len(ends) == (4 if experiment == "flow" else 2)


def test_a_time_window_joins_any_experiment():
    trainer = instantiate(composed("experiment=dnerf", "+trainer/time_window=growing").trainer, _convert_="all")
    assert trainer.time_window.num_frames(100, 0.0) == 5


@pytest.mark.parametrize("experiment", ["fast", "flow", "fast_gpu", "flow_gpu", "demo"])
def test_the_fast_path_lets_frames_in_by_time(experiment):
    added = composed("experiment=dnerf", "+trainer/time_window=growing")
    assert composed(f"experiment={experiment}").trainer.time_window == added.trainer.time_window
    assert composed("experiment=dnerf").trainer.time_window is None


@pytest.mark.parametrize("experiment", ["fast", "flow", "fast_gpu", "flow_gpu", "demo"])
def test_the_fast_path_draws_rays_where_pictures_are_wrong(experiment):
    added = composed("experiment=dnerf", "+trainer/error_map=guided")
    assert composed(f"experiment={experiment}").trainer.error_map == added.trainer.error_map
    assert isinstance(instantiate(added.trainer, _convert_="all").error_map, ErrorMap)
    assert composed("experiment=dnerf").trainer.error_map is None


def test_every_scene_has_a_config_that_builds_it():
    for name in names("scene"):
        assert isinstance(instantiate(composed(f"scene={name}").data, _convert_="all"), SyntheticData)
        make_scene(name)


def test_blender_data_reads_what_make_dataset_writes(tmp_path):
    from dnerf.data import save_blender

    source = SyntheticData(make_scene("static"), 12, num_train=2, num_val=1, num_test=1)
    save_blender({split: source.frames(split) for split in ("train", "val", "test")}, tmp_path / "scene")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("train", ["data=blender", f"data.root={tmp_path / 'scene'}", "data.resolution=null"])
    frames = instantiate(config.data, _convert_="all").frames("train")
    difference = frames.images.int() - source.frames("train").images.int()
    assert difference.abs().max() <= 1


@pytest.mark.parametrize("script", ["benchmark", "evaluate", "make_dataset", "render", "tracks"])
def test_script_configs_compose(script):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for path in names("path") if script == "render" else [None]:
            compose(script, [f"path={path}"] if path else [])


@pytest.mark.parametrize("script", ["train", "evaluate", "render", "make_dataset"])
def test_failed_jobs_of_a_multirun_are_noticed(script):
    text = (CONF / f"{script}.yaml").read_text()
    assert "_target_: sweeps.SweepWatch" in text
