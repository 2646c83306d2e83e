"""What `experiment=auto` trains: parts and choices from the config, and models for them."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra_app import build, resolved
from omegaconf import DictConfig, OmegaConf, open_dict

from dnerf.data.frames import Frames
from dnerf.planning import Part, Plan, make_plan
from dnerf.planning.plan import AS_SET, FILE, fingerprint, load_plan, settled
from dnerf.rendering.renderer import Renderer
from dnerf.training.run import Run
from dnerf.training.trainer import Trainer

OVERRIDES = "overrides.json"  # in a run's folder
FROM_DATA = "background_from_data"  # a setting: whether the background is the data's
SETTINGS = ("parts", "share", "file")  # of a plan; all others are choices


def parts_of(config: DictConfig) -> dict[str, Part]:
    """The parts about which something is to be decided; none without a plan."""
    node = OmegaConf.select(config, "plan.parts")
    return {} if node is None else {str(name): build(part, trusted=True) for name, part in node.items()}


def given_choices(config: DictConfig, parts: Mapping[str, Part], frames: Frames, folder: Path) -> dict[str, str]:
    """What is decided already: by the command line, by a saved plan, or since the model lacks what a part would set.

    Raises:
        ValueError: for a part or a candidate that there is not, or a plan of another data set.
    """
    given = {str(name): value for name, value in config.plan.items() if name not in SETTINGS and value is not None}
    choices = settled(parts, given, None if config.plan.file is None else Path(config.plan.file), fingerprint(frames))
    said = given_overrides(folder)
    for name, part in parts.items():  # what the command line says of one stands
        first = {overrides[0]: choice for choice, overrides in part.candidates.items() if overrides}
        is_said = {_key(override) for override in first} & {_key(override) for override in said}
        every = (override for overrides in part.candidates.values() for override in overrides)
        fits = all(_has(config, _key(override)) for override in every if override[0] not in "+~")
        if name not in choices and (is_said or not fits):
            choices[name] = next((first[override] for override in said if override in first), part.unchanged)
    return choices


def contradictions(settings: DictConfig, plan: Plan) -> list[str]:
    """What speaks against choices that a person made in the settings of a plan, a line each."""
    said = {name: d for name, d in plan.decisions.items() if settings.file or settings.get(name) is not None}
    return [f"plan.{name}={d.choice} stands {d.why}" for name, d in said.items() if d.by == "given" and d.why != AS_SET]


def given_overrides(folder: Path) -> list[str]:
    """The command line's, of the run that began in a folder."""
    path = folder / OVERRIDES
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else list(HydraConfig.get().overrides.task)


def as_decided(config: DictConfig, folder: Path) -> DictConfig:
    """The config with what was decided when the run in a folder began; as it is, if nothing was."""
    parts = parts_of(config)
    if not parts or not (folder / FILE).is_file():
        return config
    saved = load_plan(folder / FILE).choices
    choices = {name: part.named(name, saved.get(name, part.default)) for name, part in parts.items()}
    return composed(parts, choices, list(HydraConfig.get().overrides.task))


def composed(parts: Mapping[str, Part], choices: Mapping[str, str], task: Sequence[str]) -> DictConfig:
    """The config of a training run with some choices, as overrides have it otherwise; without the plan."""
    chosen = [override for name, part in parts.items() for override in part.candidates[choices[name]]]
    mine = {_key(override) for override in task}
    config = compose("train", [*(x for x in chosen if _key(x) not in mine), *task])
    with open_dict(config):
        config.pop("plan", None)
    return config


def as_planned(config: DictConfig, parts: Mapping[str, Part], choices: Mapping[str, str], folder: Path) -> DictConfig:
    """The resolved config of the run in a folder with some choices, and with what was found in its data."""
    planned = composed(parts, choices, given_overrides(folder))
    planned.box = config.box
    if planned.get(FROM_DATA):
        planned.background = config.background
    return resolved(planned)


def decide(
    config: DictConfig, parts: Mapping[str, Part], given: Mapping[str, str], frames: Frames, device: torch.device,
    folder: Path,
) -> tuple[Plan, Run | None]:  # fmt: skip
    """The plan, and what its trials have begun."""

    def make(choices: Mapping[str, str]) -> tuple[Renderer, Trainer]:
        candidate = as_planned(config, parts, choices, folder)
        torch.manual_seed(candidate.seed)
        return build(candidate.renderer, trusted=True).to(device), build(candidate.trainer, trusted=True)

    watching = {name: config.trainer.callbacks.get(name) for name in ("recovery", "progress_bar")}
    callbacks = {name: build(node, trusted=True) for name, node in watching.items() if node is not None}
    box = torch.tensor(config.box)
    return make_plan(parts, given, make, frames, box, seed=config.seed, share=config.plan.share, callbacks=callbacks)


def _has(config: DictConfig, key: str) -> bool:
    parent, _, leaf = key.replace("/", ".").rpartition(".")
    node = OmegaConf.select(config, parent) if parent else config
    return node is not None and leaf in node


def _key(override: str) -> str:
    parsed = OverridesParser.create().parse_override(override)
    return parsed.get_key_element().lstrip("+~").partition("@")[0]
