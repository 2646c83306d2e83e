"""Runs that were saved: their config as plain data, the objects it describes, the trained model."""

import importlib
import inspect
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, cast

import torch
import yaml

import dnerf
from dnerf.data.scene_record import SceneRecord
from dnerf.data.source import DataSource
from dnerf.rendering.renderer import Renderer
from dnerf.scenes import SCENES
from dnerf.training.tensor_files import load_weights

CONFIG = "config.yaml"
WEIGHTS = "model.safetensors"
MAX_CONFIG_BYTES = 64 * 1024
MAX_CONFIG_DEPTH = 40
MAX_KEY = 80  # characters
TARGET = "_target_"
PLUGINS = "DNERF_PLUGINS"  # environment variable: packages, separated by commas
PLUGIN_GROUP = "dnerf.plugins"  # entry points that name packages
NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


@dataclass(frozen=True)
class LoadedRun:
    """A finished run."""

    renderer: Renderer  # the trained model, in evaluation mode
    config: dict[str, Any]  # what it was built and trained by, as plain values
    folder: Path  # where it lies

    def data(self) -> DataSource:
        """Where its frames come from; `config["data"]["root"]` may be set before, if a data set has moved.

        Raises:
            ValueError: if the config describes no data source.
        """
        data = build(self.config["data"], "data")
        if not isinstance(data, DataSource):
            raise ValueError(f"{self.folder / CONFIG}: data must be a DataSource, got {type(data).__name__}")
        data.settle(self.scene().world)
        return data

    def scene(self) -> SceneRecord:
        """Cameras and times of its frames, and the way back to the data set's own units; needs no data set.

        Raises:
            ValueError: if `scene.json` is missing or damaged.
        """
        return SceneRecord.read(self.folder)


def load_run(folder: str | Path, device: str | torch.device = "cpu") -> LoadedRun:
    """The model and the config of a finished run.

    Args:
        folder: of the run.
        device: where the model is wanted.

    Raises:
        ValueError: naming the file that is missing, damaged, or names a class that runs may not name.
    """
    config = load_config(folder)
    return LoadedRun(load_renderer(folder, config, torch.device(device)), config, Path(folder))


def load_renderer(folder: str | Path, config: Mapping[str, Any], device: torch.device) -> Renderer:
    """The trained model of a run, in evaluation mode.

    Raises:
        ValueError: if the config builds no renderer, or the weights are missing, damaged or do not fit.
    """
    renderer = build(config["renderer"], "renderer")
    if not isinstance(renderer, Renderer):
        raise ValueError(f"{Path(folder) / CONFIG}: renderer must be a Renderer, got {type(renderer).__name__}")
    load_weights(renderer, Path(folder) / WEIGHTS)
    return renderer.to(device).eval()


def load_config(folder: str | Path) -> dict[str, Any]:
    """The config saved with a run: plain values without interpolations, and no class that runs may not name.

    Raises:
        ValueError: naming the file, if it is missing or is not such a config.
    """
    path = Path(folder) / CONFIG
    if not path.is_file():
        raise ValueError(f"run: {path} does not exist; {folder} is not the folder of a run")
    try:
        config = _plain_yaml(path)
    except Exception as error:
        raise ValueError(f"{path}: not a readable config ({' '.join(str(error).split())})") from error
    groups = [config.get(name) if isinstance(config, dict) else None for name in ("renderer", "data")]
    if not all(isinstance(group, dict) for group in groups):
        raise ValueError(f"{path}: expected a mapping with renderer and data, not the config of a run")
    try:
        _check_plain(config)
        check_targets(config)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return config


def build(node: Any, place: str = "", *, trusted: bool = False) -> Any:
    """The objects that a config describes: a mapping with `_target_` becomes an object of that class.

    Its other keys are arguments, built first; mappings without `_target_` and lists keep their kind.

    Args:
        node: plain values, mappings and lists.
        place: dotted, of the node in its config, for errors.
        trusted: whether any importable class may be named; otherwise those of this package, its scenes, and the
            packages that `DNERF_PLUGINS` or entry points of the group `dnerf.plugins` list.

    Raises:
        ValueError: naming the place in the config, for a class that may not be named or refuses its arguments.
    """
    check_targets(node, place, trusted=trusted)  # all of them, before anything is built
    return _built(node, place)


def check_targets(node: Any, place: str = "", *, trusted: bool = False) -> None:
    """Raise unless all classes that a config names may be named, see `build`.

    Raises:
        ValueError: naming the place.
    """
    packages = [dnerf.__name__] if trusted else _trusted_packages()
    for where, value in _nodes(node, place):
        if not isinstance(value, Mapping) or TARGET not in value:
            continue
        target, where = value[TARGET], _joined(where, TARGET)
        shown = repr(str(target)[:80])
        if not trusted and not _lies_in(str(target), packages):
            root = ascii(str(target).partition(".")[0][:40])[1:-1]
            raise ValueError(
                f"{where} must be a class of {dnerf.__name__}, or of a package that {PLUGINS} lists "
                f"({PLUGINS}={root} trusts it), got {shown}"
            )
        found = _find(target, where)
        is_maker = any(found is make for make in SCENES.values())
        is_known = trusted or _lies_in(getattr(found, "__module__", ""), packages)
        if not is_maker and not (isinstance(found, type) and is_known):
            raise ValueError(f"{where} must be a class, or an exact scene's maker, got {shown}")


def _nodes(node: Any, place: str) -> Iterator[tuple[str, Any]]:
    """A value of a config and all that it holds, each with its place, after what it lies in."""
    yield place, node
    if isinstance(node, Mapping):
        for key, value in node.items():
            yield from _nodes(value, _joined(place, key))
    elif isinstance(node, list | tuple):
        for index, value in enumerate(node):
            yield from _nodes(value, f"{place}[{index}]")


def _joined(place: str, key: object) -> str:
    return f"{place}.{key}" if place else str(key)


def _trusted_packages() -> list[str]:
    listed = [name.strip() for name in os.environ.get(PLUGINS, "").split(",")]
    return [dnerf.__name__, *(name for name in listed if name), *(e.module for e in entry_points(group=PLUGIN_GROUP))]


def _lies_in(name: str, packages: list[str]) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)


def _find(target: Any, place: str) -> Any:
    """What a dotted name means; ValueError if its module cannot be imported, or has no such thing."""
    module_name, _, name = str(target).rpartition(".")
    try:
        return getattr(importlib.import_module(module_name), name)
    except Exception as error:
        said = " ".join(str(error).split())[:200]
        raise ValueError(f"{place} names nothing that can be loaded, {str(target)[:80]!r} ({said})") from error


def _built(node: Any, place: str) -> Any:
    if isinstance(node, list | tuple):
        return [_built(value, f"{place}[{index}]") for index, value in enumerate(node)]
    if not isinstance(node, Mapping):
        return node
    made = {key: _built(value, _joined(place, key)) for key, value in node.items() if key != TARGET}
    return _called(_find(node[TARGET], place), made, place) if TARGET in node else made


def _called(make: Any, arguments: dict[str, Any], place: str) -> Any:
    """An object, from arguments by name; ValueError, naming the place, whatever the class raises."""
    try:
        complaint = _complaint(make, arguments, place)
        if not complaint:
            return make(**arguments)
    except Exception as error:
        said = " ".join(str(error).split())
        is_named = said.partition(" ")[0] in arguments  # by convention, errors begin with the argument's name
        raise ValueError(_joined(place, said) if is_named else f"{place or make.__name__}: {said}") from error
    raise ValueError(complaint)


def _complaint(make: Any, given: Mapping[str, Any], place: str) -> str:
    """What to say of an argument that there is not, or that is missing; nothing if all are well named."""
    parameters = inspect.signature(make).parameters
    named = [name for name, parameter in parameters.items() if parameter.kind in NAMED]
    takes_any = any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters.values())
    for name in given:
        if name not in named and not takes_any:
            said = f"{_joined(place, name)} is none of {make.__name__}'s arguments: {', '.join(named)}"
            return said + _who_takes(name, make)
    for name in named:
        if name not in given and parameters[name].default is inspect.Parameter.empty:
            return f"{_joined(place, name)} is missing: {make.__name__} needs it"
    return ""


def _who_takes(argument: str, make: Any) -> str:
    """Names other classes, of the package that a class lies in, with an argument of that name, if there are some."""
    package = sys.modules.get(make.__module__.rpartition(".")[0], sys.modules[make.__module__])
    names = [
        name for name, other in vars(package).items()
        if inspect.isclass(other) and not inspect.isabstract(other) and inspect.isfunction(cast(Any, other).__init__)
        and argument in inspect.signature(cast(Any, other).__init__).parameters
    ]  # fmt: skip
    return f"; {', '.join(names)} would take it" if names else ""


def _plain_yaml(path: Path) -> Any:
    """The value of a small YAML file, neither deep nor with references, which could unfold without bound."""
    with path.open("rb") as file:
        data = file.read(MAX_CONFIG_BYTES + 1)
    if len(data) > MAX_CONFIG_BYTES:
        raise ValueError(f"more than {MAX_CONFIG_BYTES} bytes")
    text, depth = data.decode(), 0
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    for event in yaml.parse(text, loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_CONFIG_DEPTH or isinstance(event, yaml.AliasEvent):
            raise ValueError(f"aliases and more than {MAX_CONFIG_DEPTH} levels are not supported")
    return yaml.load(text, loader)


def _check_plain(config: Any) -> None:
    """Raise unless keys are texts and values are numbers, texts or nothing, none of them an interpolation."""
    for place, value in _nodes(config, ""):
        for key in value if isinstance(value, dict) else ():
            if not isinstance(key, str) or not key.isprintable() or len(key) > MAX_KEY or "${" in key:
                raise ValueError(f"{place or 'config'}: keys must be short texts, got {str(key)[:MAX_KEY]!r}")
        if value is not None and not isinstance(value, dict | list | str | int | float):
            raise ValueError(f"{place} must be a number, a text or null, got {type(value).__name__}")
        if isinstance(value, str) and "${" in value:
            raise ValueError(f"{place} must be a resolved value, got an interpolation '${{'")
