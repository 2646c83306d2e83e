"""CUDA graphs: work that is the same every time, replayed without Python between its kernels."""

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

Work = Callable[[Tensor], Mapping[str, Tensor]]


@dataclass(frozen=True)
class _Graph:
    graph: torch.cuda.CUDAGraph
    inputs: Tensor
    outputs: Mapping[str, Tensor]
    gradients: tuple[Tensor | None, ...]


class GraphCache:
    """Runs work as it is the first time, records it the second, and replays it from then on, until its state changes.

    Work is what reads and writes tensors in place where they lie, reads nothing from a device, and takes the same path
    through Python for the same kind and state. Its first run compiles kernels and makes what is kept from then on. On
    the CPU work just runs.

    Args:
        device: of the work.
        generators: random generators that it draws from.
        parameters: whose gradients it leaves behind.
    """

    def __init__(
        self, device: torch.device, generators: Iterable[torch.Generator] = (), parameters: Iterable[nn.Parameter] = ()
    ) -> None:
        self.device = device
        self.generators = tuple(generators)
        self.parameters = tuple(parameters)
        self._graphs: dict[Hashable, tuple[Hashable, _Graph | None]] = {}
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    def forget(self) -> None:
        """Drop all graphs: tensors that they refer to (parameters, moments) have been replaced."""
        self._graphs.clear()

    def run(self, kind: Hashable, state: Hashable, work: Work, inputs: Tensor) -> Mapping[str, Tensor]:
        """What the work returns for its inputs; it holds until the next run of its kind.

        Args:
            kind: of the work; one graph is kept of each.
            state: what decides which path it takes through Python, and the shape of its inputs.
            work: see the class.
            inputs: what differs from run to run.
        """
        if self._stream is None:
            return work(inputs)
        known = self._graphs.get(kind)
        if known is None or known[0] != state:
            self._graphs[kind] = (state, None)
            return self._aside(work, inputs)
        graph = known[1]
        if graph is None:
            graph = self._recorded(work, inputs.clone())
            self._graphs[kind] = (state, graph)
        graph.inputs.copy_(inputs)
        graph.graph.replay()
        if any(gradient is not None for gradient in graph.gradients):
            for parameter, gradient in zip(self.parameters, graph.gradients, strict=True):
                parameter.grad = gradient
        return graph.outputs

    def _aside(self, work: Work, inputs: Tensor) -> Mapping[str, Tensor]:
        """Run on a stream that is not the default one, as recording will, so that libraries prepare for that one."""
        assert self._stream is not None
        self._stream.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(self._stream):
            outputs = work(inputs)
        torch.cuda.current_stream(self.device).wait_stream(self._stream)
        return outputs

    def _recorded(self, work: Work, inputs: Tensor) -> _Graph:
        graph = torch.cuda.CUDAGraph()
        for generator in self.generators:
            graph.register_generator_state(generator)
        for parameter in self.parameters:
            parameter.grad = None
        with torch.cuda.graph(graph, stream=self._stream):
            outputs = work(inputs)
        return _Graph(graph, inputs, outputs, tuple(parameter.grad for parameter in self.parameters))
