"""How far the field's weights exceed what proposals allow: what proposals learn by."""

from torch import Tensor

from dnerf.core.compositing import Rendering, safe_divide, sum_along_rays
from dnerf.losses.base import Batch, Loss
from dnerf.rendering.renderer import Renderer


class HistogramLoss(Loss):
    """Excess of the field's weights w over each proposal's bounds b: sum_i max(0, w_i - b_i)^2 / w_i, mean over rays.

    It is zero where the bounds hold. Proposals learn from it and the field does not: its weights count as constants.

    Source: mip-NeRF 360 (arXiv 2111.12077) eq. 13, bounds by eq. 12, see `dnerf.samplers.outer_bound`.
    """

    def check(self, model: Renderer) -> None:
        """Needs a sampler that sets bounds."""
        if not model.sampler.sets_bounds:
            raise ValueError(
                f"HistogramLoss needs a sampler with proposals that set bounds, got {type(model.sampler).__name__}"
            )

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """The sum over proposals."""
        samples, weights = rendering.samples, rendering.weights
        assert samples is not None
        assert weights is not None
        weights = weights.detach()
        total = rendering.rgb.new_zeros(())
        for bound in samples.bounds:
            excess = (weights - bound).clamp(min=0)
            # The quotient first: squares of faint weights underflow.
            total = total + rendering.mean(sum_along_rays(excess * safe_divide(excess, weights), samples))
        return total
