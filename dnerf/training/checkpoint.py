"""The state of a training run as one file: everything that a step changes, as tensors and JSON values."""

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from dnerf.training.optimizer import moments_of
from dnerf.training.records import TrainingRecord
from dnerf.training.run import Run
from dnerf.training.tensor_files import MAX_HEADER, check_fit, decode, encode, num_bytes

FORMAT = 2
NUMBERS = ("step", "seconds", "progress", "num_rays", "rays_done")  # of a run, in its file


def encode_run(run: Run, data: str) -> bytes:
    """The state of a run, between two steps, as the bytes of one file; `data` is the fingerprint of its frames."""
    # The optimiser's tensors are named by parameter: position in its groups would change with the groups.
    moments = {
        f"optimizer.{name}.{key}": torch.as_tensor(value)
        for name, parameter in run.renderer.named_parameters()
        for key, value in run.optimizer.state.get(parameter, {}).items()
    }
    facts = {
        "format": FORMAT, "device": run.generator.device.type, **{name: getattr(run, name) for name in NUMBERS},
        "record": None if run.last_record is None else vars(run.last_record), "data": data,
    }  # fmt: skip
    return encode({**_fixed(run), **moments, **_random_states(run)}, facts)


def restore_run(run: Run, content: bytes, where: object, data: str) -> None:
    """Take over a state written by `encode_run`, before the run's first step; nothing changes unless all of it fits.

    Raises:
        ValueError: naming `where`, if the bytes are damaged or belong to another model, format or kind of device.
    """
    tensors, facts = decode(content, where)
    checked = _checked_facts(facts, where, run)
    if checked.get("data") != data:
        raise ValueError(f"{where}: the training frames are not those that this run began with")
    moments = {name: value for name, value in tensors.items() if name.startswith("optimizer.")}
    others = {name: value for name, value in tensors.items() if name not in moments}
    check_fit({**_fixed(run), **_random_states(run)}, others, where)
    state = _optimizer_state(moments, run, where)
    for name, generator in _generators(run).items():
        try:
            torch.Generator(generator.device).set_state(tensors[name])
        except RuntimeError as error:
            raise ValueError(f"{where}: random.*: not the state of a generator ({error})") from error
    for name, generator in _generators(run).items():
        generator.set_state(tensors[name])
    for name, part in run.parts.items():
        start = f"{name}."
        part.load_state_dict({k.removeprefix(start): value for k, value in tensors.items() if k.startswith(start)})
    run.optimizer.load_state_dict({**run.optimizer.state_dict(), "state": state})
    for name in NUMBERS:
        setattr(run, name, checked[name])
    run.last_record = None if checked["record"] is None else TrainingRecord(**checked["record"])


def max_bytes(run: Run) -> int:
    """Most bytes a checkpoint can take: tensors, and two moments and a step per parameter."""
    tensors = _fixed(run)
    return 3 * num_bytes(tensors) + 64 * len(tensors) + MAX_HEADER


def _fixed(run: Run) -> dict[str, Tensor]:
    """The tensors of modules and callbacks, whose names and shapes are known before the first step."""
    return {f"{k}.{n}": value for k, part in run.parts.items() for n, value in part.state_dict().items()}


def _generators(run: Run) -> dict[str, torch.Generator]:
    """The run's generator and torch's own, which a module might draw from."""
    found = {"random.run": run.generator, "random.cpu": torch.default_generator}
    if run.generator.device.type == "cuda":
        found["random.cuda"] = torch.cuda.default_generators[run.generator.device.index or 0]
    return found


def _random_states(run: Run) -> dict[str, Tensor]:
    return {name: generator.get_state() for name, generator in _generators(run).items()}


def _checked_facts(facts: dict[str, Any] | None, where: object, run: Run) -> dict[str, Any]:
    device = run.generator.device.type
    if facts is None or facts.get("format") != FORMAT:
        raise ValueError(f"{where}: not a checkpoint of format {FORMAT} (weights alone cannot be continued)")
    if facts.get("device") != device:
        raise ValueError(f"{where}: device must be {str(facts.get('device'))[:20]} as before, got {device}")
    whole = {"step": (0, 2**53), "num_rays": (1, run.most_rays), "rays_done": (0, 2**63)}
    for name, (low, high) in {**whole, "seconds": (0, math.inf), "progress": (0, 1)}.items():
        value, kind = facts.get(name), int if name in whole else float
        if type(value) is not kind or not low <= value <= high or value == math.inf:
            wanted = "a whole number" if kind is int else "a number"
            raise ValueError(f"{where}: {name} must be {wanted} in [{low}, {high}], got {str(value)[:40]}")
    if facts.get("record") is not None:
        _check_record(facts["record"], where)
    return {"record": None, **facts}


def _check_record(record: object, where: object) -> None:
    names = {field.name for field in fields(TrainingRecord)}
    if not isinstance(record, dict) or record.keys() != names or not isinstance(record["losses"], dict):
        raise ValueError(f"{where}: record must be an object with {', '.join(sorted(names))}, or null")
    for name, value in {**record["losses"], **{k: v for k, v in record.items() if k != "losses"}}.items():
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise ValueError(f"{where}: record.{name[:40]} must be a number, got {str(value)[:40]}")


def _optimizer_state(moments: Mapping[str, Tensor], run: Run, where: object) -> dict[int, dict[str, Tensor]]:
    """The optimiser's tensors by place in its groups, checked; parameters that had no gradient yet have none."""
    parameters = dict(run.renderer.named_parameters())
    found: dict[str, dict[str, Tensor]] = {}
    for full, value in moments.items():
        name, _, key = full.removeprefix("optimizer.").rpartition(".")
        if name not in parameters or key not in moments_of(run.optimizer, parameters[name]):
            raise ValueError(f"{where}: does not fit its config: unexpected {full!r}")
        check_fit({full: torch.empty(()) if key == "step" else parameters[name]}, {full: value}, where)
        # A copy, because the tensors share the file's memory, at addresses that vector instructions find slow.
        found.setdefault(name, {})[key] = value.clone()
    for name, values in found.items():
        if missing := moments_of(run.optimizer, parameters[name]) - values.keys():
            raise ValueError(f"{where}: does not fit its config: missing {sorted(missing)} of {name}")
    order = [id(parameter) for group in run.optimizer.param_groups for parameter in group["params"]]
    return {order.index(id(parameters[name])): values for name, values in found.items()}
