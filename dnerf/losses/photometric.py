"""How far rendered colours are from the true ones."""

from torch import Tensor, nn

from dnerf.core.checks import check_choice, check_positive
from dnerf.core.compositing import Rendering
from dnerf.core.schedules import Schedule
from dnerf.losses.base import Batch, Loss
from dnerf.rendering.renderer import Renderer


class PhotometricLoss(Loss):
    """Mean squared or Huber error of colour, of the earlier (coarse) passes as well: NeRF eq. 6.

    Where any colour may lie behind (`RandomBackground`), its variance times the squared error of opacity is added.

    Args:
        kind: "mse", or "huber" (quadratic below `delta`, linear above, scaled to agree with the mse for small errors).
        delta: where Huber turns linear, in units of colour.
        proposal_weight: weight of the coarse passes' errors.
        weight: factor of the term.

    Raises:
        ValueError: for another kind or numbers that are not positive.
    """

    def __init__(
        self, kind: str = "mse", *, delta: float = 0.1, proposal_weight: float = 1.0, weight: float | Schedule = 1.0
    ) -> None:
        super().__init__(weight)
        check_choice("kind", kind, ("mse", "huber"))
        check_positive("delta", delta)
        check_positive("proposal_weight", proposal_weight, allow_zero=True)
        self.kind = kind
        self.delta = delta
        self.proposal_weight = proposal_weight

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """Error of the image plus the weighted errors of its proposals' images."""
        loss = self._error(rendering, batch, model)
        for proposal in rendering.proposals:
            loss = loss + self.proposal_weight * self._error(proposal, batch, model)
        return loss

    def _error(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        if self.kind == "mse":
            errors = nn.functional.mse_loss(rendering.rgb, batch.target, reduction="none")
        else:
            errors = 2 * nn.functional.huber_loss(rendering.rgb, batch.target, delta=self.delta, reduction="none")
        missing = (rendering.opacity - batch.rgba[:, 3]).square()
        return rendering.mean(errors.mean(-1) + model.background.variance * missing)
