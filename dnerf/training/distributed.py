"""Several processes that train one model: each renders its share of every batch, gradients are averaged by DDP.

A ray's random numbers do not depend on how many processes share the batch, so the result does not either, up to the
rounding of sums. Start with `torchrun --nproc_per_node=2 scripts/train.py ...`.
"""

import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from datetime import timedelta
from operator import attrgetter
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.overrides import TorchFunctionMode

from dnerf.rendering.renderer import Renderer
from dnerf.samplers import Sampler

Made = TypeVar("Made")

# What gloo and NCCL say, as plain RuntimeErrors, when another process does not answer.
LOST = re.compile("gloo|nccl|timed out|timeout|connection|peer", re.IGNORECASE)


class LostProcess(RuntimeError):
    """Another process of the group has died, or has not answered for too long."""


@dataclass(frozen=True)
class Processes:
    """The processes that train together; a single one needs no communication."""

    rank: int = 0  # number of this process
    size: int = 1  # how many there are

    @property
    def is_first(self) -> bool:
        """Whether this process is the one that writes files."""
        return self.rank == 0

    def share(self, num_rays: int) -> slice:
        """The rays of a batch that this process renders; shares differ by one ray at most."""
        return slice(num_rays * self.rank // self.size, num_rays * (self.rank + 1) // self.size)

    def wrap(self, renderer: Renderer) -> nn.Module:
        """The module whose forward pass trains: the renderer, under DDP if there are several processes."""
        if self.size == 1:
            return renderer
        with warnings.catch_warnings():  # `merge_observations` merges those buffers that differ between processes
            # The argument's successor exchanges buffers at the start, which is as good, but is younger than torch 2.6.
            warnings.simplefilter("ignore", FutureWarning)
            return DistributedDataParallel(renderer, broadcast_buffers=False, find_unused_parameters=True)

    def same_randomness(self, generator: torch.Generator, num_rays: int) -> AbstractContextManager[Any]:
        """While it lasts, draws of the generator, one row per ray of the share, are rows of those for all rays."""
        return nullcontext() if self.size == 1 else _SharedDraws(generator, self.share(num_rays), num_rays)

    def agree(self, seconds: float, num_samples: int, signal: int) -> tuple[float, int, int]:
        """One common view of a step: the first process's seconds, all samples, and any signal to stop."""
        if self.size == 1:
            return seconds, num_samples, signal
        mine = torch.tensor([seconds, num_samples, signal], dtype=torch.float64)
        rows = [torch.empty_like(mine) for _ in range(self.size)]
        dist.all_gather(rows, mine)
        seen = torch.stack(rows)
        return float(seen[0, 0]), int(seen[:, 1].sum()), int(seen[:, 2].max())

    def all_rays(self, values: Tensor, num_rays: int) -> Tensor:
        """Numbers (num_rays,) of all rays of a batch, of those of this process's share."""
        if self.size == 1:
            return values
        padded = nn.functional.pad(values, (0, -(-num_rays // self.size) - len(values)))
        rows = [torch.empty_like(padded) for _ in range(self.size)]
        dist.all_gather(rows, padded)
        shares = (Processes(rank, self.size).share(num_rays) for rank in range(self.size))
        return torch.cat([row[: share.stop - share.start] for row, share in zip(rows, shares, strict=True)])

    def mean(self, values: Mapping[str, float]) -> dict[str, float]:
        """Each number's mean over the processes."""
        if self.size == 1:
            return dict(values)
        total = torch.tensor(list(values.values()), dtype=torch.float64)
        dist.all_reduce(total)
        return dict(zip(values, (total / self.size).tolist()))

    def merge_observations(self, renderer: nn.Module, step: int | None = None) -> None:
        """Give every sampler the maximum of what all processes observed; those that update at `step`, if given."""
        if self.size == 1:
            return
        for module in renderer.modules():
            if isinstance(module, Sampler) and (step is None or step % module.update_every == 0):
                for name in module.observed:
                    dist.all_reduce(attrgetter(name)(module), dist.ReduceOp.MAX)

    def from_first(self, make: Callable[[], Made]) -> Made:
        """What the first process makes, given to all; only it touches the disk.

        Raises:
            ValueError: in every process, if making it raised ValueError or OSError in the first.
        """
        if self.size == 1:
            return make()
        made: list[Any] = [None]
        if self.is_first:
            try:
                made = [make()]
            except (ValueError, OSError) as error:
                made = [ValueError(str(error))]
        dist.broadcast_object_list(made, device=torch.device("cpu"))
        if isinstance(made[0], ValueError):
            raise made[0]
        return made[0]

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Say plainly what has happened when a process does not answer.

        Raises:
            LostProcess: for errors of the communication.
        """
        try:
            yield
        except RuntimeError as error:
            if self.size == 1 or not (isinstance(error, dist.DistError) or LOST.search(str(error))):
                raise
            raise LostProcess(
                f"process {self.rank} of {self.size} lost another one, which died or hangs "
                f"({' '.join(str(error).split())[:200]}); the last checkpoint is good: start again with resume=true"
            ) from error


class _SharedDraws(TorchFunctionMode):
    """Draws of a generator are made for all rays, of which one share is kept."""

    def __init__(self, generator: torch.Generator, share: slice, num_rays: int) -> None:
        super().__init__()
        self.generator, self.share, self.num_rays = generator, share, num_rays

    def __torch_function__(
        self, function: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if kwargs.get("generator") is not self.generator:
            return function(*args, **kwargs)
        name = function.__name__
        if name in ("rand", "randn"):
            size = tuple(kwargs.pop("size", args[0] if args and not isinstance(args[0], int) else args))
            return function((self._all(name, size[0]), *size[1:]), **kwargs)[self.share]
        if name in ("uniform_", "normal_", "random_", "exponential_", "bernoulli_"):
            own: Tensor = args[0]
            everyone = own.new_empty((self._all(name, own.shape[0]), *own.shape[1:]))
            return own.copy_(function(everyone, *args[1:], **kwargs)[self.share])
        raise NotImplementedError(f"{name} with the run's generator cannot be shared between processes")

    def _all(self, name: str, rows: int) -> int:
        wanted = self.share.stop - self.share.start
        if rows != wanted:
            raise ValueError(f"{name} with the run's generator must draw one row per ray, {wanted}, got {rows}")
        return self.num_rays


def is_launched() -> bool:
    """Whether this process was started as one of several, by torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1


@contextmanager
def started(device: torch.device, timeout: float) -> Iterator[Processes]:
    """Join the processes that torchrun started, and leave them when the block ends; alone otherwise.

    Whoever does not answer for `timeout` seconds is given up. After an error the group stays: it goes with the process,
    which should then end by `os._exit`.
    """
    if not is_launched():
        yield Processes()
        return
    backend = "cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo"
    if device.type == "cuda":
        torch.cuda.set_device(device)
    dist.init_process_group(backend, timeout=timedelta(seconds=timeout))
    # No `finally`: whoever drops the last reference to a group with work that has failed, DDP's reducer in a traceback
    # for one, waits for a thread that waits for the interpreter's lock, for ever.
    yield Processes(dist.get_rank(), dist.get_world_size())
    dist.destroy_process_group()
