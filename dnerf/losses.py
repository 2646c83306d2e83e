"""Training losses: each looks at a rendering and its target and returns one number."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from dnerf.checks import check_choice, check_positive
from dnerf.compositing import Rendering
from dnerf.renderer import Renderer


class Loss(nn.Module, ABC):
    """One term of the training loss, its weight included."""

    @abstractmethod
    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        """Loss, a scalar.

        Args:
            rendering: of a batch of R rays.
            target: (R, 3) true colours on the rendering's background.
            renderer: the model, for terms about its parameters or its field.
        """


class PhotometricLoss(Loss):
    """Mean squared or Huber error of colour, of the earlier (coarse) passes as well: NeRF eq. 6.

    Args:
        kind: "mse", or "huber" (quadratic below `delta`, linear above, scaled to agree with the mse for small errors).
        delta: where Huber turns linear, in units of colour.
        proposal_weight: weight of the coarse passes' errors.

    Raises:
        ValueError: for another kind or numbers that are not positive.
    """

    def __init__(self, kind: str = "mse", *, delta: float = 0.1, proposal_weight: float = 1.0) -> None:
        super().__init__()
        check_choice("kind", kind, ("mse", "huber"))
        check_positive("delta", delta)
        check_positive("proposal_weight", proposal_weight, allow_zero=True)
        self.kind = kind
        self.delta = delta
        self.proposal_weight = proposal_weight

    def _error(self, rgb: Tensor, target: Tensor) -> Tensor:
        if self.kind == "mse":
            return nn.functional.mse_loss(rgb, target)
        return 2 * nn.functional.huber_loss(rgb, target, delta=self.delta)

    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        """Error of the picture plus the weighted errors of its proposals' pictures."""
        loss = self._error(rendering.rgb, target)
        for proposal in rendering.proposals:
            loss = loss + self.proposal_weight * self._error(proposal.rgb, target)
        return loss


class OpacityEntropyLoss(Loss):
    """Binary entropy of each ray's opacity: rays should be clear or blocked, not hazy (for solid scenes).

    Args:
        weight: factor of the term.
    """

    def __init__(self, weight: float = 1e-3) -> None:
        super().__init__()
        check_positive("weight", weight, allow_zero=True)
        self.weight = weight

    def forward(self, rendering: Rendering, target: Tensor, renderer: Renderer) -> Tensor:
        """Weighted mean of -o log o - (1 - o) log(1 - o); o is kept 1e-4 from 0 and 1, so that gradients are finite."""
        opacity = rendering.opacity.clamp(1e-4, 1 - 1e-4)
        entropy = -(opacity * torch.log(opacity) + (1 - opacity) * torch.log1p(-opacity))
        return self.weight * entropy.mean()
