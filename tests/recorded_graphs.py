"""Graphs recorded on the CPU, as CUDA graphs are on a GPU: what is replayed is what was done once, not what is written.

Operations are recorded with the memory that they read and write, and run again on that memory, without Python. Whatever
the host decides or computes while it records stays as it was; replays know nothing of it. So work that takes another
path, reads a number of the host or makes new tensors to keep shows itself here as it would on a GPU.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from device_waits import DeviceWaits
from torch import Tensor
from torch.utils._pytree import tree_leaves

from dnerf.kernels.march import MarchedSamples
from dnerf.kernels.march_to_size import march_to_size
from dnerf.rendering.cuda_graphs import GraphCache, Work, _Graph
from dnerf.rendering.frame_graphs import FrameGraphs
from dnerf.rendering.renderer import Renderer
from dnerf.samplers.occupancy_grid import OccupancyGrid, spread_over


@torch.library.custom_op("dnerf_tests::march_to_size", mutates_args=())
def _march_to_size(
    occupancy: Tensor, rays: list[Tensor], aabb: Tensor, step: Tensor, size: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    origins, directions, near, far, times, jitter = rays
    marched, wanted = march_to_size(
        origins, directions, near, far, times=times, jitter=jitter, occupancy=occupancy, aabb=aabb, step=step, size=size
    )
    return *marched, wanted


def _one_operation(*rays: Tensor, **others: Any) -> tuple[MarchedSamples, Tensor]:
    """`march_to_size` as on a GPU: on the CPU it is made of parts of any size."""
    times, jitter = others.pop("times"), others.pop("jitter")
    *columns, wanted = _march_to_size(rays=[*rays, times, jitter], **others)
    return MarchedSamples(*columns), wanted


def _occupied_positions(grid: OccupancyGrid, unit: Tensor) -> tuple[Tensor, Tensor]:
    """`OccupancyGrid.occupied_positions` as on a GPU: on the CPU it keeps a list of any length."""
    return grid._within(spread_over(grid.occupied, unit[:, 0]), unit[:, 1:])


def _graph_frames(renderer: Renderer) -> FrameGraphs | None:
    """As on a GPU."""
    if renderer.graphs and renderer._frames is None:
        renderer._frames = FrameGraphs(renderer.device)
    return renderer._frames


def _memory(values: Any) -> set[int]:
    return {leaf.untyped_storage().data_ptr() for leaf in tree_leaves(values) if isinstance(leaf, Tensor)}


class _Recording(DeviceWaits):
    """Operations within a `with` block, in order; `replay` runs them again on the same memory."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[tuple[Any, Any, Any, list[Tensor]]] = []
        self.was_replayed = False

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = _memory((args, kwargs))
        outputs = super().__torch_dispatch__(function, types, args, kwargs)
        made = [x for x in tree_leaves(outputs) if isinstance(x, Tensor) and not _memory(x) & given]
        self.operations.append((function, args, kwargs or {}, made))
        return outputs

    def replay(self) -> None:
        """Run all again, but for the first time: recording on a GPU does nothing, here it did all."""
        if not self.was_replayed:
            self.was_replayed = True
            return
        with torch._C._AutoDispatchBelowAutograd():
            for function, args, kwargs, made in self.operations:
                outputs = function(*args, **kwargs)
                if made:
                    given = _memory((args, kwargs))
                    again = [x for x in tree_leaves(outputs) if isinstance(x, Tensor) and not _memory(x) & given]
                    for kept, new in zip(made, again, strict=True):
                        kept.copy_(new)


class RecordedCache(GraphCache):
    """A cache of graphs that records and replays on the CPU, too, and counts both."""

    replays = 0
    recordings = 0
    is_recording = False

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._stream = object()  # type: ignore[assignment]

    def run(self, kind: Any, state: Any, work: Work, inputs: Tensor) -> Mapping[str, Tensor]:
        known = self._graphs.get(kind)
        type(self).replays += known is not None and known[0] == state and known[1] is not None
        return super().run(kind, state, work, inputs)

    def _aside(self, work: Work, inputs: Tensor) -> Mapping[str, Tensor]:
        return work(inputs)

    def _recorded(self, work: Work, inputs: Tensor) -> _Graph:
        type(self).recordings += 1
        for parameter in self.parameters:
            parameter.grad = None
        recording = _Recording()
        with recording, patch.object(RecordedCache, "is_recording", True):
            outputs = work(inputs)
        assert recording.found == [], f"a GPU would be waited for: {recording.found}"
        return _Graph(recording, inputs, outputs, tuple(parameter.grad for parameter in self.parameters))  # type: ignore[arg-type]


@contextmanager
def recorded_graphs(*, replays: bool = True) -> Iterator[type[RecordedCache]]:
    """Within a `with` block, steps and images that a GPU would replay are replayed on the CPU.

    Args:
        replays: False for the same work done anew each time, with which replays agree to the last bit.
    """
    RecordedCache.replays = RecordedCache.recordings = 0
    cache = RecordedCache if replays else GraphCache
    with (
        patch("dnerf.training.trainer.GraphCache", cache),
        patch("dnerf.rendering.frame_graphs.GraphCache", cache),
        patch("dnerf.deformations.flow._is_recorded", lambda _: RecordedCache.is_recording),
        patch.object(OccupancyGrid, "occupied_positions", _occupied_positions),
        patch("dnerf.samplers.occupancy.march_to_size", _one_operation),
        patch.object(Renderer, "_graph_frames", _graph_frames),
    ):
        yield RecordedCache
