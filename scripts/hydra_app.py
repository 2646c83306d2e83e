"""What the scripts share: Hydra entry points with one-line errors, objects from configs, saved configs."""

import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
import sweeps
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from settings import check_settings

import dnerf
from dnerf.core.process import prepare_process
from dnerf.data import SceneRecord
from dnerf.rendering.renderer import Renderer
from dnerf.training import runs
from dnerf.training.signals import TrainingStopped

WRONG_INPUT = 2
USER_ERRORS = (ValueError, OSError, MemoryError, HydraException, OmegaConfBaseException)
NO_MEMORY = "DefaultCPUAllocator"
PATHS = (
    "data.root", "data_root", "out_dir", "run", "output", "out", "table", "path.file", "film", "video",
    "images", "model", "masks",
)  # fmt: skip
PLAIN = re.compile(r"(\.{0,2}/|[A-Za-z_])[A-Za-z0-9_./:-]*")  # no number, nothing that Hydra's grammar knows
CONF = str(Path(__file__).resolve().parents[1] / "conf")


def run_app(main: Callable[[DictConfig], None], config_name: str) -> None:
    """Run a Hydra application; what the user got wrong ends in one line on standard error and exit code 2.

    In a multirun a job that fails leaves the others alone; at the end the exit code is 2 if one has failed. SIGINT
    and SIGTERM end with 130 and 143. Set DNERF_TRACEBACK=1 to see the whole traceback instead.
    """
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    _tell_workers_where_we_are()
    prepare_process()
    is_sweep = any(word in ("--multirun", "-m") for word in sys.argv[1:])
    sys.argv[1:] = [quoted_path(word, is_sweep=is_sweep) for word in sys.argv[1:]]
    with _one_line_errors():
        hydra.main(version_base="1.3", config_path=CONF, config_name=config_name)(_as_job(main, config_name))()
        sweeps.finish()


def quoted_path(word: str, *, is_sweep: bool = False) -> str:
    """A word of a command line as Hydra has to have it, where it sets a path: people type paths as their shell wants.

    `~` becomes the home folder. Left alone are null, what is quoted already, interpolations, and lists of a sweep.
    """
    key, equals, value = word.partition("=")
    if key.lstrip("+") not in PATHS or not equals or value in ("", "null", "???") or "${" in value:
        return word
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        return word
    if is_sweep and re.search(r"[,()]", value):
        return word
    value = os.path.expanduser(value)
    if PLAIN.fullmatch(value) and value.lower() not in ("true", "false", "nan", "inf"):
        return f"{key}={value}"
    # Backslashes count before a quote alone; the closing one is such.
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", value)
    escaped += "\\" * (len(escaped) - len(escaped.rstrip("\\")))
    return f"{key}='{escaped}'"


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
        print(f"{stop}; continue with resume=true", file=sys.stderr)
        sys.exit(stop.exit_code)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    except USER_ERRORS as error:
        if os.environ.get("DNERF_TRACEBACK") == "1":
            raise
        print(f"error: {one_line(error)}", file=sys.stderr)
        sys.exit(WRONG_INPUT)
    except BrokenProcessPool as error:
        print(
            f"error: a worker of the sweep was killed ({one_line(error)[:200]}); the same command with resume=true "
            "runs what is missing",
            file=sys.stderr,
        )
        sys.exit(WRONG_INPUT)
    except Exception as error:
        if NO_MEMORY in str(error) and os.environ.get("DNERF_TRACEBACK") != "1":  # torch has no class for it
            print(f"error: {one_line(error).partition(NO_MEMORY)[2].lstrip(': ')}", file=sys.stderr)
            sys.exit(WRONG_INPUT)
        raise


def _tell_workers_where_we_are() -> None:
    """Let the processes that launchers start find the scripts and the package, wherever they begin."""
    known = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    wanted = [str(Path(__file__).resolve().parent), str(Path(dnerf.__file__).resolve().parents[1])]
    os.environ["PYTHONPATH"] = os.pathsep.join(wanted + [path for path in known if path and path not in wanted])


def one_line(error: BaseException) -> str:
    """An error's message on one line, of its cause where Hydra wraps it."""
    while isinstance(error, HydraException) and error.__cause__ is not None:
        error = error.__cause__
    return " ".join(line.strip() for line in str(error).splitlines() if line.strip())


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


def resolved(config: DictConfig) -> DictConfig:
    """A config without interpolations."""
    values = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    assert isinstance(values, DictConfig)
    return values


def build(config: DictConfig, *, trusted: bool = False) -> Any:
    """The objects that a config node describes.

    Args:
        config: a node of a composed config, or of a run's.
        trusted: whether it stems from the user's own command line, where any importable class may be named.

    Raises:
        ValueError: naming the place in the config.
    """
    place = config._get_full_key(None)
    return runs.build(OmegaConf.to_container(config, resolve=True, throw_on_missing=True), place, trusted=trusted)


def resolve_device(name: str) -> torch.device:
    """The device of a name; "auto" is CUDA where there is one.

    Raises:
        ValueError: for an unknown device or one that is not there.
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
    return device


def load_config(run: str) -> DictConfig:
    """The config saved with a run, see `dnerf.training.runs.load_config`.

    Raises:
        ValueError: naming the file, if it is missing or is not such a config.
    """
    config = OmegaConf.create(runs.load_config(run))
    assert isinstance(config, DictConfig)
    return config


def load_scene(run: str) -> SceneRecord:
    """The cameras, times and world of a run's data set; ValueError as `SceneRecord.read`."""
    return SceneRecord.read(run)


def load_renderer(run: str, config: DictConfig, device: torch.device) -> Renderer:
    """The trained model of a run, in evaluation mode.

    Raises:
        ValueError: if the config builds no renderer or the checkpoint is missing, damaged or does not fit.
    """
    plain: Any = OmegaConf.to_container(config)
    return runs.load_renderer(run, plain, device)
