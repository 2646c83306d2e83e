"""What the scripts share: Hydra entry points with one-line errors, objects from configs, saved configs."""

import importlib
import logging
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

import hydra
import sweeps
import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from settings import check_settings

import dnerf
from dnerf.allocator import keep_freed_memory
from dnerf.checkpoints import load_weights
from dnerf.distributed import LostProcess, is_launched
from dnerf.renderer import Renderer
from dnerf.scenes import SCENES
from dnerf.stopping import TrainingStopped

WRONG_INPUT = 2
USER_ERRORS = (ValueError, OSError, MemoryError, LostProcess, HydraException, OmegaConfBaseException)
NO_MEMORY = "DefaultCPUAllocator"
MAX_CONFIG_BYTES = 64 * 1024
MAX_CONFIG_DEPTH = 40

CONF = str(Path(__file__).resolve().parents[1] / "conf")


def run_app(main: Callable[[DictConfig], None], config_name: str) -> None:
    """Run a Hydra application; what the user got wrong ends in one line on standard error and exit code 2.

    In a multirun a job that fails leaves the others alone; at the end the exit code is 2 if one has failed. SIGINT
    and SIGTERM end with 130 and 143. Also sets the C allocator to keep memory between steps. Set DNERF_TRACEBACK=1 to
    see the whole traceback instead.
    """
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    _tell_workers_where_we_are()
    keep_freed_memory()
    with _one_line_errors():
        hydra.main(version_base="1.3", config_path=CONF, config_name=config_name)(_as_job(main, config_name))()
        sweeps.finish()


def _as_job(main: Callable[[DictConfig], None], script: str) -> Callable[[DictConfig], None]:
    """One job: its errors are caught here, before Hydra adds lines or, in a multirun, stops the sweep."""

    def job(config: DictConfig) -> None:
        if HydraConfig.get().mode == RunMode.RUN:
            with _one_line_errors():
                check_settings(config, script)
                main(config)
            return
        try:
            with _one_line_errors():
                sweeps.begin_job()
                check_settings(config, script)
                main(config)
        except SystemExit as end:
            if end.code != WRONG_INPUT:
                raise
            sweeps.record_failure(end.__context__ or end)
        # A defect of the program, too, is this job's alone.
        except Exception as error:  # noqa: BLE001
            traceback.print_exc()
            sweeps.record_failure(error)

    return job


@contextmanager
def _one_line_errors() -> Iterator[None]:
    """Leave with one line and an exit code that says what happened: wrong input, or a signal to stop."""
    try:
        yield
    except TrainingStopped as stop:
        if int(os.environ.get("RANK", "0")) == 0:
            print(f"{stop}; continue with resume=true", file=sys.stderr)
        _leave(stop.exit_code)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        _leave(128 + signal.SIGINT)
    except USER_ERRORS as error:
        if os.environ.get("DNERF_TRACEBACK") == "1":
            raise
        rank = os.environ.get("RANK", "0")
        print(f"error: {f'process {rank}: ' if rank != '0' else ''}{one_line(error)}", file=sys.stderr)
        _leave(WRONG_INPUT)
    except BrokenProcessPool as error:
        print(
            f"error: a worker of the sweep was killed ({one_line(error)[:200]}); the same command with resume=true "
            "runs what is missing",
            file=sys.stderr,
        )
        _leave(WRONG_INPUT)
    except Exception as error:
        if NO_MEMORY in str(error) and os.environ.get("DNERF_TRACEBACK") != "1":  # torch has no class for it
            print(f"error: {one_line(error).partition(NO_MEMORY)[2].lstrip(': ')}", file=sys.stderr)
            _leave(WRONG_INPUT)
        if not is_launched():
            raise
        traceback.print_exc()
        _leave(1)


def _leave(code: int) -> NoReturn:
    """End this process; one of several at once, since taking down a group that has lost a member may hang."""
    if is_launched():
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _tell_workers_where_we_are() -> None:
    """Let the processes that launchers start find the scripts and the package, wherever they begin."""
    known = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    wanted = [str(Path(__file__).resolve().parent), str(Path(dnerf.__file__).resolve().parents[1])]
    os.environ["PYTHONPATH"] = os.pathsep.join(wanted + [path for path in known if path and path not in wanted])


def one_line(error: BaseException) -> str:
    """An error's message on one line, of its cause where Hydra wraps it; what Python says of a call names the place."""
    place = ""
    while isinstance(error, HydraException) and error.__cause__ is not None:
        found = re.search(r"full_key: (\S+)", str(error))
        place = found.group(1) if found else place
        error = error.__cause__
    line = " ".join(line.strip() for line in str(error).splitlines() if line.strip())
    return f"{place}: {line}" if place and not isinstance(error, USER_ERRORS) else line


def moved(saved: DictConfig, data_root: str | None) -> None:
    """Let a run's config know where its scene lies now, if it has moved.

    Raises:
        ValueError: if a place is given for a scene that lies nowhere.
    """
    if data_root is None:
        return
    if "root" not in saved.data:
        raise ValueError(f"data_root must be null, this run's frames are of an exact scene, got {data_root}")
    saved.data.root = data_root


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
    """The device of a name; "auto" is CUDA where there is one. Under torchrun "cuda" is each process's own GPU.

    Raises:
        ValueError: for an unknown device or one that is not there, or more processes than GPUs.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ValueError(f"device must be auto, cpu, cuda or cuda:<index>, got {name!r}") from error
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"device must be auto, cpu, cuda or cuda:<index>, got {name!r}")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device {name!r} was asked for, but torch sees no CUDA device")
    if device.type == "cuda" and device.index is None and is_launched():
        index, count = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if index >= count:
            raise ValueError(
                f"device {name!r} gives each process a GPU of its own, but this one is number {index} here and torch "
                f"sees {count}; start fewer (--nproc_per_node={count}) or ask for device=cpu"
            )
        return torch.device("cuda", index)
    return device


def load_config(run: str) -> DictConfig:
    """The config saved with a run; it is data, never code: no interpolations, targets of this package only.

    Raises:
        ValueError: naming the file, if it is missing or is not such a config.
    """
    path = Path(run) / "config.yaml"
    if not path.is_file():
        raise ValueError(f"run: {path} does not exist; {run} is not the folder of a run")
    try:
        value = _plain_yaml(path)
        config = OmegaConf.create(value)
    except Exception as error:
        raise ValueError(f"{path}: not a readable config ({one_line(error)})") from error
    groups = [value.get(name) if isinstance(value, dict) else None for name in ("renderer", "data")]
    if not isinstance(config, DictConfig) or not all(isinstance(group, dict) for group in groups):
        raise ValueError(f"{path}: expected a mapping with renderer and data, not the config of a run")
    container = OmegaConf.to_container(config, resolve=False)
    if "${" in str(container):
        raise ValueError(f"{path}: expected resolved values, got an interpolation '${{'")
    try:
        _check_targets(container)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return config


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
