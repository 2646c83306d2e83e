"""How far rendered colours are from the true ones."""

from torch import Tensor

from dnerf.core.checks import check_positive
from dnerf.core.compositing import Rendering
from dnerf.core.schedules import Schedule
from dnerf.losses.base import Batch, Loss
from dnerf.rendering.renderer import Renderer


class PhotometricLoss(Loss):
    """Mean squared error of colour, of the earlier (coarse) passes as well: NeRF eq. 6.

    Where any colour may lie behind (`RandomBackground`), its variance times the squared error of opacity is added.

    Args:
        proposal_weight: weight of the coarse passes' errors.
        weight: factor of the term.

    Raises:
        ValueError: for numbers below zero.
    """

    def __init__(self, *, proposal_weight: float = 1.0, weight: float | Schedule = 1.0) -> None:
        super().__init__(weight)
        check_positive("proposal_weight", proposal_weight, allow_zero=True)
        self.proposal_weight = proposal_weight

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """Error of the image plus the weighted errors of its proposals' images."""
        loss = self._error(rendering, batch, model)
        for proposal in rendering.proposals:
            loss = loss + self.proposal_weight * self._error(proposal, batch, model)
        return loss

    def _error(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        errors = (rendering.rgb - batch.target).square().mean(-1)
        missing = (rendering.opacity - batch.rgba[:, 3]).square()
        return rendering.mean(errors + model.background.variance * missing)
