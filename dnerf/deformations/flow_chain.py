"""Several flows in a row: a velocity that changes along the way to canonical space."""

from collections.abc import Mapping
from typing import cast

from torch import Tensor, nn

from dnerf.deformations.base import InvertibleDeformation
from dnerf.deformations.flow import EvaluationCounts, FlowDeformation


class FlowChain(InvertibleDeformation):
    """Flows one after the other, each from where the one before ended.

    With frozen clocks it is one flow whose velocity is another in each part of the way, as in registration with large
    deformations (Beg et al. 2005): it reaches maps that are not the exponential of one stationary field. Where each
    takes one Euler step they are residual blocks, invertible while each keeps to its own bound (`FlowDeformation`;
    Behrmann et al. 2019), so a chain bends more than one flow before it folds: determinants multiply.

    Args:
        flows: by name, in the order in which world positions meet them.

    Raises:
        ValueError: if there is none, or something else than a flow.
    """

    def __init__(self, flows: Mapping[str, FlowDeformation]) -> None:
        super().__init__()
        if not flows:
            raise ValueError("flows must be at least one, got none")
        for name, flow in flows.items():
            if not isinstance(flow, FlowDeformation):
                raise ValueError(f"flows must be FlowDeformation, got {type(flow).__name__} for {name}")
        self.flows = nn.ModuleDict(flows)

    @property
    def evaluations(self) -> EvaluationCounts:
        """Evaluations of velocity fields: in the latest solves and in all, of all flows together."""
        counts = [flow.evaluations for flow in self.links()]
        last, total, solves = (sum(getattr(count, name) for count in counts) for name in ("last", "total", "solves"))
        return EvaluationCounts(last, total, solves)

    def links(self) -> tuple[FlowDeformation, ...]:
        """The flows as world positions meet them."""
        return tuple(cast(FlowDeformation, flow) for flow in self.flows.values())

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of world positions (..., 3) at times (...,); raises as the flows do."""
        for flow in self.links():
            positions = flow(positions, times)
        return positions

    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """World positions (..., 3) at times (...,) of canonical positions (..., 3); raises as the flows do."""
        for flow in reversed(self.links()):
            canonical = flow.inverse(canonical, times)
        return canonical

    def reverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """The equations solved backwards in the same steps: `inverse` without corrections."""
        for flow in reversed(self.links()):
            canonical = flow.reverse(canonical, times)
        return canonical


Flow = FlowDeformation | FlowChain
"""What losses about flows look at."""
