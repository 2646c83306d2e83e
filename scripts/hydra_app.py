"""What the scripts share: Hydra entry points with one-line errors, objects from configs, run folders."""

import importlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import dnerf
from dnerf.allocator import keep_freed_memory
from dnerf.checkpoints import load_weights
from dnerf.files import write_text
from dnerf.renderer import Renderer
from dnerf.scenes import SCENES

CONF = str(Path(__file__).resolve().parents[1] / "conf")


def run_app(main: Callable[[DictConfig], None], config_name: str) -> None:
    """Run a Hydra application; what the user got wrong ends in one line on standard error and exit code 2.

    Also sets the C allocator to keep memory between steps. Set DNERF_TRACEBACK=1 to see the whole traceback instead.
    """
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    keep_freed_memory()
    with _one_line_errors():
        hydra.main(version_base="1.3", config_path=CONF, config_name=config_name)(_one_line_errors()(main))()


@contextmanager
def _one_line_errors() -> Iterator[None]:
    """Leave with one line and exit code 2 on what the user got wrong (within a job, before Hydra adds lines)."""
    try:
        yield
    except (ValueError, OSError, HydraException, OmegaConfBaseException) as error:
        if os.environ.get("DNERF_TRACEBACK") == "1":
            raise
        print(f"error: {_one_line(error)}", file=sys.stderr)
        sys.exit(2)


def _one_line(error: BaseException) -> str:
    while isinstance(error, HydraException) and error.__cause__ is not None:
        error = error.__cause__
    return " ".join(line.strip() for line in str(error).splitlines() if line.strip())


def build(config: DictConfig) -> Any:
    """Instantiate a config node whose `_target_`s all lie in this package.

    Raises:
        ValueError: naming the target that does not.
    """
    _check_targets(OmegaConf.to_container(config, resolve=True))
    return hydra.utils.instantiate(config, _convert_="all")


def _check_targets(node: object) -> None:
    if isinstance(node, dict):
        if "_target_" in node:
            _check_target(str(node["_target_"]))
        node = list(node.values())
    if isinstance(node, list):
        for child in node:
            _check_targets(child)


def _check_target(target: str) -> None:
    """Allow the classes that this package defines and its scenes' makers; no other function, nothing it imports."""
    module_name, _, name = target.rpartition(".")
    found = None
    if module_name.partition(".")[0] == dnerf.__name__:
        with suppress(ImportError):
            found = getattr(importlib.import_module(module_name), name, None)
    is_class = isinstance(found, type) and found.__module__.startswith(f"{dnerf.__name__}.")
    is_maker = any(found is make for make in SCENES.values())
    if not is_class and not is_maker:
        raise ValueError(f"_target_ must be a class or scene of the package {dnerf.__name__}, got {target!r}")


def resolve_device(name: str) -> torch.device:
    """The device of a name; "auto" is CUDA where there is one.

    Raises:
        ValueError: for an unknown device or one that is not there.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ValueError(f"device must be auto, cpu, cuda or cuda:<index>, got {name!r}") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device {name!r} was asked for, but torch sees no CUDA device")
    return device


def new_run_folder(config: DictConfig) -> Path:
    """Make the folder of a new run and save the resolved config in it.

    In a multirun every job gets its own folder below `out_dir`, named by its overrides.

    Raises:
        ValueError: if the folder holds another run.
    """
    choice = HydraConfig.get().runtime.choices.get("experiment") or "run"
    stamp = datetime.now().strftime("%Y-%m-%d-%H-%M-%S")
    folder = Path(config.out_dir or f"runs/{choice}-{stamp}")
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        folder = folder / (HydraConfig.get().job.override_dirname or str(HydraConfig.get().job.num))
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"out_dir: {folder} already holds another run or other files; choose a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "config.yaml", OmegaConf.to_yaml(config, resolve=True))
    return folder


def load_config(run: str) -> DictConfig:
    """The config saved with a run; it is data, never code: no interpolations, targets of this package only.

    Raises:
        ValueError: naming the file, if it is missing or is not such a config.
    """
    path = Path(run) / "config.yaml"
    if not path.is_file():
        raise ValueError(f"run: {path} does not exist; {run} is not the folder of a run")
    try:
        config = OmegaConf.load(path)
    except Exception as error:
        raise ValueError(f"{path}: not a readable config ({_one_line(error)})") from error
    if not isinstance(config, DictConfig) or "renderer" not in config or "data" not in config:
        raise ValueError(f"{path}: expected a mapping with renderer and data, not the config of a run")
    container = OmegaConf.to_container(config, resolve=False)
    if "${" in str(container):
        raise ValueError(f"{path}: expected resolved values, got an interpolation '${{'")
    try:
        _check_targets(container)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return config


def load_renderer(run: str, config: DictConfig, device: torch.device) -> Renderer:
    """The trained model of a run, in evaluation mode.

    Raises:
        ValueError: if the config builds no renderer or the checkpoint is missing, damaged or does not fit.
    """
    renderer = build(config.renderer)
    if not isinstance(renderer, Renderer):
        raise ValueError(
            f"{run}/config.yaml: renderer must be a dnerf.renderer.Renderer, got {type(renderer).__name__}"
        )
    load_weights(renderer, Path(run) / "model.safetensors")
    return renderer.to(device).eval()
