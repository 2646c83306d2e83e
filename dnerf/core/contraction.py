"""Unbounded space in a box: what lies outside is drawn in, the farther the more."""

from torch import Tensor


def contract(positions: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """Map a box to [-1, 1]^3, side by side, and all that lies beyond into [-2, 2]^3.

    With x the position in units of the box's half sides, x inside and (2 - 1 / |x|) x / |x| beyond, |x| its largest
    component. It is continuous, and its Jacobian is 1 at the faces along the normal.

    Args:
        positions: (..., 3) in world units.
        box: (2, 3) lowest and highest corner.

    Returns:
        Contracted positions (..., 3), and max(|x|, 1) (...,).

    Source: mip-NeRF 360 (arXiv 2111.12077) eq. 10, there with the Euclidean norm, for a ball.
    """
    half = 0.5 * (box[1] - box[0])
    unit = (positions - 0.5 * (box[0] + box[1])) / half
    beyond = unit.abs().amax(-1).clamp(min=1)
    return unit * ((2 - 1 / beyond) / beyond)[..., None], beyond
