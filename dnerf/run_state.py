"""Where a training run stands: everything that a step changes, as tensors and JSON values, and its checkpoints."""

import hashlib
import logging
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from dnerf.checkpoints import MAX_HEADER, check_fit, decode, encode, num_bytes, read_limited
from dnerf.data.frames import Frames
from dnerf.files import write_bytes
from dnerf.optimizers import AdamMuon, moments_of
from dnerf.records import TrainingRecord, not_finite

logger = logging.getLogger(__name__)

FORMAT = 1
NAME = re.compile(r"step_(\d{8,})\.safetensors")


@dataclass
class RunState:
    """All that a training step changes; a run continued from it cannot be told from one that never stopped.

    Args:
        modules: by name, whose parameters and buffers change; "renderer" is the one that is optimised.
        optimizer: of the renderer's parameters.
        generator: of the random rays, points and backgrounds.
        num_rays: rays of the next step.
        step: steps done.
        seconds: training time spent.
        rays_done: rays of all steps done.
        record: the last record of training as JSON values, or None before the first.
        data: fingerprint of the frames that are learnt, "" if nobody asks.
        rollbacks: how often the run has been brought back, see `dnerf.recovery`.
        begun: training time that had been spent before the first step.
    """

    modules: Mapping[str, nn.Module]
    optimizer: AdamMuon
    generator: torch.Generator
    num_rays: int
    step: int = 0
    seconds: float = 0.0
    rays_done: int = 0
    record: dict[str, Any] | None = None
    data: str = ""
    rollbacks: int = 0
    begun: float = 0.0

    def encode(self) -> bytes:
        """The state as the bytes of one file."""
        facts = {
            "format": FORMAT,
            "device": self.generator.device.type,
            "step": self.step,
            "seconds": self.seconds,
            "begun": self.begun,
            "num_rays": self.num_rays,
            "rays_done": self.rays_done,
            "rollbacks": self.rollbacks,
            "record": self.record,
            "data": self.data,
        }
        return encode({**self._modules(), **self._moments(), **self._random_states()}, facts)

    def restore(self, data: bytes, where: object, *, max_rays: int) -> None:
        """Take over a state written by `encode`; nothing changes unless all of it fits.

        Args:
            data: the bytes.
            where: what errors name.
            max_rays: most rays of a step.

        Raises:
            ValueError: if the data are damaged or belong to another model, format or kind of device.
        """
        try:
            tensors, facts = decode(data)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
        device = self.generator.device.type
        checked = _checked_facts(facts, where, device, max_rays)
        if checked.get("data") != self.data:
            raise ValueError(f"{where}: the training frames are not those that this run began with")
        expected = {**self._modules(), **self._random_states()}
        moments = {name: value for name, value in tensors.items() if name.startswith("optimizer.")}
        check_fit(expected, {name: value for name, value in tensors.items() if name not in moments}, where)
        parameters = dict(self.modules["renderer"].named_parameters())
        state = _optimizer_state(moments, self.optimizer, parameters, where)
        self._set_random_states(tensors, where)
        for name, module in self.modules.items():
            own = f"{name}."
            module.load_state_dict({k.removeprefix(own): tensors[k] for k in expected if k.startswith(own)})
        self._set_moments(state, parameters)
        self.step, self.seconds, self.begun = checked["step"], checked["seconds"], checked["begun"]
        self.num_rays, self.rays_done, self.rollbacks = checked["num_rays"], checked["rays_done"], checked["rollbacks"]
        self.record = checked["record"]

    def _modules(self) -> dict[str, Tensor]:
        return {f"{k}.{n}": value for k, module in self.modules.items() for n, value in module.state_dict().items()}

    def _moments(self) -> dict[str, Tensor]:
        """The optimiser's tensors, named by parameter: position in its groups would change with the groups."""
        return {
            f"optimizer.{name}.{key}": torch.as_tensor(value)
            for name, parameter in self.modules["renderer"].named_parameters()
            for key, value in self.optimizer.state.get(parameter, {}).items()
        }

    def _set_moments(self, state: Mapping[str, dict[str, Tensor]], parameters: Mapping[str, nn.Parameter]) -> None:
        order = [parameter for group in self.optimizer.param_groups for parameter in group["params"]]
        places = {id(parameter): index for index, parameter in enumerate(order)}
        # Copies, because the tensors share the file's memory, at addresses that vector instructions find slow.
        indexed = {places[id(parameters[n])]: {k: v.clone() for k, v in values.items()} for n, values in state.items()}
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": indexed})

    def _random_states(self) -> dict[str, Tensor]:
        """The generator's state and those of torch's own, which a module might draw from."""
        states = {"random.run": self.generator.get_state(), "random.cpu": torch.get_rng_state()}
        if self.generator.device.type == "cuda":
            states["random.cuda"] = torch.cuda.get_rng_state(self.generator.device)
        return states

    def _set_random_states(self, tensors: Mapping[str, Tensor], where: object) -> None:
        """Set all states, or none if one is refused."""
        before = self._random_states()
        try:
            self._enter_random_states(tensors)
        except RuntimeError as error:
            self._enter_random_states(before)
            raise ValueError(f"{where}: random.*: not the state of a generator ({error})") from error

    def _enter_random_states(self, tensors: Mapping[str, Tensor]) -> None:
        self.generator.set_state(tensors["random.run"])
        torch.set_rng_state(tensors["random.cpu"])
        if self.generator.device.type == "cuda":
            torch.cuda.set_rng_state(tensors["random.cuda"], self.generator.device)


def _checked_facts(facts: dict[str, Any] | None, where: object, device: str, max_rays: int) -> dict[str, Any]:
    if facts is None or facts.get("format") != FORMAT:
        raise ValueError(f"{where}: not a checkpoint of format {FORMAT} (weights alone cannot be continued)")
    if facts.get("device") != device:
        raise ValueError(f"{where}: device must be {str(facts.get('device'))[:20]} as before, got {device}")
    bounds = (("step", 0, 2**53), ("num_rays", 1, max_rays), ("rays_done", 0, 2**63), ("rollbacks", 0, 2**31))
    for name, low, high in bounds:
        value = facts.get(name)
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise ValueError(f"{where}: {name} must be a whole number in [{low}, {high}], got {str(value)[:40]}")
    facts = {"begun": 0.0, **facts}  # checkpoints of before it was there have none
    for name in ("seconds", "begun"):
        value = facts.get(name)
        if not isinstance(value, float) or not 0 <= value < math.inf:
            raise ValueError(f"{where}: {name} must be a number >= 0, got {str(value)[:40]}")
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


def _optimizer_state(
    moments: Mapping[str, Tensor],
    optimizer: torch.optim.Optimizer,
    parameters: Mapping[str, nn.Parameter],
    where: object,
) -> dict[str, dict[str, Tensor]]:
    """The optimiser's tensors by parameter and name, checked; parameters that had no gradient yet have none."""
    state: dict[str, dict[str, Tensor]] = {}
    for full, value in moments.items():
        name, _, key = full.removeprefix("optimizer.").rpartition(".")
        if name not in parameters or key not in moments_of(optimizer, parameters[name]):
            raise ValueError(f"{where}: does not fit its config: unexpected {full!r}")
        like = torch.empty(()) if key == "step" else parameters[name]
        check_fit({full: like}, {full: value}, where)
        state.setdefault(name, {})[key] = value
    for name, values in state.items():
        if missing := moments_of(optimizer, parameters[name]) - values.keys():
            raise ValueError(f"{where}: does not fit its config: missing {sorted(missing)} of {name}")
    return state


class CheckpointFolder:
    """Checkpoints of one run, `step_<number>.safetensors`; the newest and the good one before it are kept.

    Args:
        folder: made when the first checkpoint is written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        self._good: Path | None = None

    def save(self, state: RunState, *, must_succeed: bool = True) -> None:
        """Write a checkpoint, then remove all but it and the last one that was written or read well.

        Args:
            state: what to write.
            must_succeed: whether a full disk is an error; otherwise it is a warning, and training can go on.

        Raises:
            OSError: if it cannot be written; those that were there stay.
            FloatingPointError: if parameters are not finite: such a state is not worth keeping.
        """
        path = self.folder / f"step_{state.step:08d}.safetensors"
        if names := not_finite(state.modules["renderer"]):
            raise FloatingPointError(f"step {state.step}: parameters not finite: {', '.join(names)}")
        try:
            write_bytes(path, state.encode())
        except OSError as error:
            if must_succeed:
                raise
            logger.warning("step %d: no checkpoint, the last one stays: %s", state.step, error)
            return
        for other in self._files():
            if other not in (path, self._good):
                other.unlink(missing_ok=True)
        self._good = path

    def read(self, max_bytes: int) -> bytes | None:
        """The newest checkpoint that is whole, or None if there are none at all.

        Raises:
            ValueError: if there are some, and none is whole.
        """
        problems = []
        for path in sorted(self._files(), key=_step, reverse=True):
            try:
                data = read_limited(path, max_bytes)
                decode(data)
            except ValueError as error:
                message = str(error) if str(path) in str(error) else f"{path}: {error}"
                problems.append(message)
                logger.warning("passed over a checkpoint: %s", message)
                continue
            self._good = path
            return data
        if problems:
            raise ValueError(f"{self.folder}: no checkpoint can be read; {problems[0]}")
        return None

    @property
    def is_begun(self) -> bool:
        """Whether there is any checkpoint, whole or not."""
        return bool(self._files())

    def clear(self) -> None:
        """Remove all checkpoints."""
        for path in self._files():
            path.unlink(missing_ok=True)
        self._good = None

    def _files(self) -> list[Path]:
        return [path for path in self.folder.glob("step_*.safetensors") if NAME.fullmatch(path.name)]


def _step(path: Path) -> int:
    match = NAME.fullmatch(path.name)
    assert match is not None
    return int(match[1])


def fingerprint(frames: Frames) -> str:
    """A digest of pictures, poses, times and camera."""
    digest = hashlib.sha256(repr((frames.intrinsics, frames.near, frames.far, frames.background)).encode())
    for tensor in (frames.images, frames.poses, frames.times):
        digest.update(tensor.cpu().contiguous().numpy().data)
    return digest.hexdigest()


def max_bytes(modules: Mapping[str, nn.Module]) -> int:
    """Most bytes a checkpoint of these modules can take: their tensors, and two moments and a step per parameter."""
    tensors = {f"{k}.{n}": value for k, module in modules.items() for n, value in module.state_dict().items()}
    return 3 * num_bytes(tensors) + 64 * len(tensors) + MAX_HEADER


@contextmanager
def advice_on_memory(run: RunState) -> Iterator[None]:
    """Turn a GPU's lack of memory within a `with` block into an error that says what to lower."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise MemoryError(
            f"step {run.step + 1}: the GPU's memory does not suffice for {run.num_rays} rays; lower trainer.num_rays, "
            "trainer.target_samples or trainer.max_rays, or set renderer.precision=bfloat16; a checkpoint, if there "
            f"is one, is good ({' '.join(str(error).split())[:120]})"
        ) from error
