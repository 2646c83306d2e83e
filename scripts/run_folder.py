"""The folder of a run: a new one, or the one whose training is continued."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import sweeps
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from hydra_app import load_config, moved, resolved
from omegaconf import DictConfig, OmegaConf, open_dict
from planning import FROM_DATA, OVERRIDES, as_decided

from dnerf.core.files import TEMPORARY, claimed, remove_leftovers, write_json, write_text
from dnerf.data.scene_record import SCENE
from dnerf.planning.plan import FILE
from dnerf.training.checkpoint_folder import CHECKPOINTS, CheckpointFolder

# What may be another when a run is continued: how long, where and how it is watched, not what is trained.
CHANGEABLE = (
    "out_dir", "resume", "device", "data_root", "evaluate_split", "evaluate_frames", "chunk", "data.root",
    "trainer.num_steps", "trainer.max_seconds", "trainer.log_every", "trainer.callbacks.box_warning",
    *(f"trainer.callbacks.{name}" for name in ("checkpoints", "log", "previews", "progress_bar")),
)  # fmt: skip
OWN_FOLDERS = (CHECKPOINTS, "previews")


def continued(config: DictConfig) -> DictConfig:
    """The config that a run goes by: the given one, checked against the folder's own if it is continued.

    With `resume=true` what the command does not name is taken from the folder, so that the original one need not be
    repeated; what it names must be as it was, unless it may change (`CHANGEABLE`).

    Raises:
        ValueError: if `out_dir` is not given, or names the setting that differs from the run's own.
    """
    folder = folder_of(config) if config.resume else None
    if folder is None or not (folder / "config.yaml").is_file():
        if config.data_root is not None:
            raise ValueError(f"data_root must be null unless a run is continued, got {config.data_root}; set data.root")
        return config
    saved = load_config(str(folder))
    hydra = HydraConfig.get()
    overrides = OverridesParser.create().parse_overrides(list(hydra.overrides.task))
    given = {override.get_key_element().lstrip("+~").partition("@")[0] for override in overrides}
    # It was refused, or stopped, before its first record.
    if _is_free(folder) and not all(map(_may_change, given)):
        return config
    moved(saved, config.data_root)
    values = as_decided(config, folder).copy()
    # What the run has found in its data: it knows.
    for name in ("box", *(("background",) if values.get(FROM_DATA) and saved.get(FROM_DATA) else ())):
        if name in saved:
            values[name] = saved[name]
    values = resolved(values)
    if given & set(hydra.runtime.choices):  # an experiment or another group was named: all of it must agree
        moved(values, config.data_root)
        _check_same(_leaves(saved), _leaves(values), folder)
        return values
    before, now = ({key: OmegaConf.select(node, key) for key in given} for node in (saved, values))
    _check_same(before, now, folder)
    for key in filter(_may_change, given):
        OmegaConf.update(saved, key, OmegaConf.select(values, key), force_add=True)
    return saved


def _may_change(key: str) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in CHANGEABLE)


def _check_same(before: dict[str, Any], now: dict[str, Any], folder: Path) -> None:
    for key in sorted(before.keys() | now.keys()):
        if not _may_change(key) and before.get(key) != now.get(key):
            raise ValueError(
                f"resume: {key} must be {before.get(key)} as when {folder} began, got {now.get(key)}; "
                "choose another out_dir for another run"
            )


def _leaves(node: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted names and values of a config's leaves; lists are values."""
    result: dict[str, Any] = {}
    for key, value in node.items():
        nested = isinstance(value, DictConfig) and value
        result |= _leaves(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return result


def folder_of(config: DictConfig) -> Path:
    """Where a run's files go: `out_dir`, below it in a multirun, or a new name if none is given.

    Raises:
        ValueError: if a run is to be continued that has no name.
    """
    if config.resume and not config.out_dir:
        raise ValueError("resume=true needs out_dir, the folder of the run to be continued")
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        return sweeps.sweep_folder() / sweeps.job_name()
    if config.out_dir:
        return Path(config.out_dir)
    choice = HydraConfig.get().runtime.choices.get("experiment") or "run"
    return Path(f"runs/{choice}-{datetime.now().strftime('%Y-%m-%d-%H-%M-%S')}")


@contextmanager
def opened(config: DictConfig) -> Iterator[Path]:
    """Make or reopen a run's folder and hold it for this process; the resolved config lies in it.

    Raises:
        ValueError: if the folder holds another run and `resume` is not set, holds no run at all or links, is in use,
            or holds a model whose training cannot be continued.
    """
    folder = folder_of(config)
    holds_run, is_free = (folder / "config.yaml").is_file(), _is_free(folder)
    if folder.exists() and not (holds_run and config.resume) and not is_free:
        hint = "continue it with resume=true or choose" if holds_run else "choose"
        raise ValueError(f"out_dir: {folder} already holds another run or other files; {hint} a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    for path in folder.iterdir():
        if path.is_symlink():  # a folder that somebody else made could have us write anywhere
            raise ValueError(f"out_dir: {path} is a link; a run's folder holds files and folders of its own")
    if (folder / "model.safetensors").exists() and not CheckpointFolder(folder / CHECKPOINTS).is_begun:
        raise ValueError(f"resume: {folder} holds a model but no checkpoint to continue from; choose a new out_dir")
    with claimed(folder):
        for path in (folder, *(folder / name for name in OWN_FOLDERS)):
            remove_leftovers(path)
        save_config(folder, config)
        if is_free or not (folder / OVERRIDES).exists():
            write_json(folder / OVERRIDES, list(HydraConfig.get().overrides.task))
        yield folder


def save_config(folder: Path, config: DictConfig) -> None:
    """Write the config, resolved, into the run's folder."""
    saved = config.copy()
    with open_dict(saved):
        saved.out_dir, saved.resume = str(folder), False
    write_text(folder / "config.yaml", OmegaConf.to_yaml(saved, resolve=True))


def _is_free(folder: Path) -> bool:
    """Whether a folder is empty but for what a run leaves that was refused, or killed, before its first record."""
    if not folder.is_dir():
        return False
    paths = [path for path in folder.iterdir() if not path.name.startswith(TEMPORARY)]
    left = {path.name for path in paths if not path.is_dir() or any(path.iterdir())}
    # A lone config.yaml may be anybody's.
    return not left or left - {SCENE, FILE} == {"config.yaml", OVERRIDES}
