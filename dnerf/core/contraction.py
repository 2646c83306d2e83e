"""Unbounded space in a box: what lies outside is drawn in, the farther the more."""

from torch import Tensor

from dnerf.core.checks import check_choice

SHAPES = ("box", "ball")


def contract(positions: Tensor, box: Tensor, shape: str = "box") -> tuple[Tensor, Tensor]:
    """Map a box to [-1, 1]^3, side by side, and all that lies beyond into [-2, 2]^3.

    With x the position in units of the box's half sides, x inside and (2 - 1 / |x|) x / |x| beyond. |x| is the largest
    component, or for "ball" the Euclidean norm: then the ball inside the box stays, and space beyond fills a ball of
    twice its size, as direction and disparity, NeRF++'s inverted sphere, in one point. It is continuous, and its
    Jacobian is 1 where |x| = 1 along the normal.

    Args:
        positions: (..., 3) in world units.
        box: (2, 3) lowest and highest corner.
        shape: one of `SHAPES`.

    Returns:
        Contracted positions (..., 3), and max(|x|, 1) (...,).

    Source: mip-NeRF 360 (arXiv 2111.12077) eq. 10, for the ball; NeRF++ (arXiv 2010.07492) section 4.
    """
    check_choice("shape", shape, SHAPES)
    half = 0.5 * (box[1] - box[0])
    unit = (positions - 0.5 * (box[0] + box[1])) / half
    # The norm has no derivative at the middle, which stays where it is.
    size = unit.abs().amax(-1) if shape == "box" else unit.square().sum(-1).clamp(min=1).sqrt()
    beyond = size.clamp(min=1)
    return unit * ((2 - 1 / beyond) / beyond)[..., None], beyond
