"""Every config composes, instantiates and takes a step; `experiment=fast` is what the presets make in Python."""

from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from torch import nn

from dnerf.core.backgrounds import ConstantBackground
from dnerf.data import SyntheticData, save_blender
from dnerf.deformations import IdentityDeformation, unwrapped
from dnerf.fields import GridField
from dnerf.scenes import make_scene
from dnerf.training import Callback
from dnerf.training.presets import make_renderer, make_trainer
from dnerf.training.runs import build

CONF = Path(__file__).parents[1] / "conf"
BOX = [[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]]
TINY = (
    "data.resolution=16", "data.num_train=2", "data.num_val=1", "data.num_test=1", f"data.box={BOX}",
    "trainer.num_steps=2", "trainer.num_rays=8", "trainer.log_every=1",
)  # fmt: skip
MOST_SETTINGS = {"dnerf": 70, "fast": 85, "flow": 95}


def names(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@cache
def composed(*overrides: str) -> DictConfig:
    """A training's config; the same one for the same overrides, so leave it as it is."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train", list(overrides))


def built(config: DictConfig, name: str) -> Any:
    """A part of a config's, as the training script builds it from a command line."""
    return build(OmegaConf.to_container(config[name], resolve=True, throw_on_missing=True), name, trusted=True)


def parts(*overrides: str) -> tuple[Any, Any, Any]:
    return tuple(built(composed(*overrides), name) for name in ("data", "renderer", "trainer"))


PARTS = OmegaConf.to_container(composed("experiment=auto").plan.parts)
CANDIDATES = [(part, name) for part, node in PARTS.items() for name in node["candidates"]]  # type: ignore[union-attr]


@pytest.mark.parametrize(("part", "candidate"), CANDIDATES, ids=lambda word: word)
def test_every_candidate_of_the_plan_instantiates_and_takes_a_step(part: str, candidate: str) -> None:
    overrides = PARTS[part]["candidates"][candidate]  # type: ignore[index]
    data, renderer, trainer = parts(*TINY, "~trainer.callbacks", "experiment=auto", *overrides)
    assert trainer.fit(renderer, data.frames("train")).step == 2


GROUPS = ("background", "deformation", "experiment", "field", "renderer", "sampler", "trainer/pixels")
CHOICES = [f"{group}={name}" for group in GROUPS for name in names(group) if (group, name) != ("renderer", "base")]


@pytest.mark.parametrize("choice", CHOICES)
def test_config_composes_instantiates_and_takes_a_step(choice: str) -> None:
    """With one loss, which needs nothing of the model, unless the choice brings its own."""
    alone = () if choice.startswith("experiment=") else ("trainer/losses=rgb",)
    alone = (*alone, "field=sdf") if choice == "sampler=sphere_tracing" else alone
    data, renderer, trainer = parts(*TINY, "~trainer.callbacks", *alone, choice)
    before = [p.detach().clone() for p in renderer.parameters()]
    assert trainer.fit(renderer, data.frames("train")).step == 2
    assert any(not torch.equal(a, b) for a, b in zip(before, renderer.parameters()))


def test_every_loss_joins_the_flow() -> None:
    added = ("field=planes_canonical", "+trainer/losses=[smoothness,rest,distortion]")
    of_surfaces = {"eikonal"}  # that field has none: see `experiment=sdf`
    changes = (*added, *TINY, "~trainer.callbacks", "trainer.num_steps=4")
    data, renderer, trainer = parts("experiment=flow", *changes)
    assert set(trainer.losses) == set(names("trainer/losses")) - of_surfaces - {"histogram"}  # see experiment=proposal
    record = trainer.fit(renderer, data.frames("train"))
    assert set(record.losses) == {"loss", *trainer.losses}  # all of them have their turn in every fourth step


@pytest.mark.parametrize("callback", names("trainer/callbacks"))
def test_every_callback_joins_the_training(callback: str, tmp_path: Path) -> None:
    data, renderer, trainer = parts(*TINY, f"+trainer/callbacks={callback}")
    assert isinstance(trainer.callbacks[callback], Callback)
    assert trainer.fit(renderer, data.frames("train"), folder=tmp_path).step == 2


def test_the_default_callbacks_come_in_this_order() -> None:
    """Recovery first, since later ones do not see the record of a step that it takes back."""
    wanted = ["recovery", "log", "checkpoints", "progress_bar", "box_warning", "weight_average"]
    assert list(composed("experiment=fast").trainer.callbacks) == wanted


@pytest.mark.parametrize(("experiment", "slower"), [("fast", 4), ("flow", 8)])
def test_the_networks_of_the_deformation_take_orthogonalised_steps(experiment: str, slower: int) -> None:
    """A rate that no module declares is no error, so a renamed group would go unnoticed."""
    _, renderer, trainer = parts(f"experiment={experiment}", *TINY)
    optimizer = trainer.optimizer.build(renderer)
    names = {id(p): name for name, p in renderer.named_parameters()}
    matrices = [names[id(p)] for group in optimizer.param_groups if group["orthogonal"] for p in group["params"]]
    assert len(matrices) >= 3
    assert all(name.startswith("field.deformation.") for name in matrices)
    rates = {names[id(p)]: group["lr"] for group in optimizer.param_groups for p in group["params"]}
    ends = {name for name, rate in rates.items() if rate == rates[matrices[0]] / slower}
    assert ends == {name for name in rates if ".output." in name and "deformation" in name}
    assert len(ends) == (4 if experiment == "flow" else 2)


@pytest.mark.parametrize("experiment", sorted(MOST_SETTINGS))
def test_an_experiment_has_no_more_settings_than_one_can_read(experiment: str) -> None:
    def count(node: Any) -> int:
        if not isinstance(node, dict):
            return 1
        return sum(count(value) for key, value in node.items() if key != "_target_")

    assert count(OmegaConf.to_container(composed(f"experiment={experiment}"))) <= MOST_SETTINGS[experiment]


SKIPPED = ("_parameters", "_buffers", "_modules", "callbacks")  # the first three are looked at by themselves


def described(part: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """All that a part was made with, by dotted place: numbers, texts, shapes of parameters, values of buffers."""
    if isinstance(part, nn.Module):
        yield place, type(part).__name__
        for name, value in part.named_parameters(recurse=False):
            yield f"{place}.{name}", value.shape
        for name, value in part.named_buffers(recurse=False):
            yield f"{place}.{name}", (value.dtype, value.tolist() if value.numel() < 10_000 else value.shape)
        for name, value in part.named_children():
            yield from described(value, f"{place}.{name}")
    if isinstance(part, torch.Tensor):
        yield place, part.tolist()
    elif isinstance(part, Mapping):
        for key, value in part.items():
            yield from described(value, f"{place}.{key}")
    elif isinstance(part, list | tuple):
        for index, value in enumerate(part):
            yield from described(value, f"{place}.{index}")
    elif hasattr(part, "__dict__") and type(part).__module__.startswith("dnerf."):
        for name, value in vars(part).items():
            if name not in SKIPPED:
                yield from described(value, f"{place}.{name}")
    elif isinstance(part, int | float | str | None):
        yield place, part


def test_the_presets_are_the_fast_experiment() -> None:
    _, renderer, trainer = parts("experiment=fast", f"data.box={BOX}", "trainer.max_seconds=7")
    for made, expected, least in ((make_renderer(BOX), renderer, 100), (make_trainer(max_seconds=7), trainer, 50)):
        assert dict(described(made)) == dict(described(expected))
        assert len(dict(described(made))) > least


def test_a_preset_takes_parts_of_ones_own() -> None:
    field, black = GridField(BOX, (4,)), ConstantBackground("black")
    renderer = make_renderer(torch.tensor(BOX), deformation=IdentityDeformation(), field=field, background=black)
    assert renderer.field.canonical is field
    assert renderer.background is black
    assert isinstance(unwrapped(renderer.field.deformation), IdentityDeformation)


def test_every_scene_has_a_config_that_builds_it() -> None:
    for name in names("scene"):
        assert isinstance(built(composed(f"scene={name}"), "data"), SyntheticData)
        make_scene(name)


def test_blender_data_reads_what_make_dataset_writes(tmp_path: Path) -> None:
    source = SyntheticData(make_scene("static"), 12, num_train=2, num_val=1, num_test=1)
    save_blender({split: source.frames(split) for split in ("train", "val", "test")}, tmp_path / "scene")
    config = composed("data=blender", f"data.root={tmp_path / 'scene'}", "data.resolution=null")
    frames = built(config, "data").frames("train")
    difference = frames.images.int() - source.frames("train").images.int()
    assert difference.abs().max() <= 1


@pytest.mark.parametrize("script", ["benchmark", "evaluate", "make_dataset", "mesh", "render", "report", "tracks"])
def test_script_configs_compose(script: str) -> None:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for path in names("path") if script == "render" else [None]:
            compose(script, [f"path={path}"] if path else [])


@pytest.mark.parametrize("script", ["train", "evaluate", "render", "make_dataset"])
def test_failed_jobs_of_a_multirun_are_noticed(script: str) -> None:
    text = (CONF / f"{script}.yaml").read_text()
    assert "_target_: sweeps.SweepWatch" in text
