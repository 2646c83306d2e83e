"""One frame of a sequence as arrays: colour, depth, opacity, motion, deformation, truth."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dnerf.cameras import Camera
from dnerf.checks import check_choice, check_positive
from dnerf.compositing import Rendering, safe_divide, sum_along_rays
from dnerf.motion import motion_model, motion_vectors
from dnerf.renderer import Renderer
from dnerf.sequences.views import View

LAYERS: dict[str, tuple[str, ...]] = {
    "rgb": ("rgb",),
    "depth": ("depth", "opacity"),
    "opacity": ("opacity",),
    "motion": ("motion",),
    "deformation": ("deformation", "opacity"),
    "compare": ("rgb", "truth"),
}
"""The arrays that each output is made of."""

OUTPUTS = tuple(LAYERS)
MIN_OPACITY = 0.5
MAX_RESIDUAL = 0.05
"""Distance in canonical space, in world units, above which a motion counts as not found."""

Truth = Callable[[View], Tensor]


def check_outputs(outputs: Sequence[str]) -> None:
    """Raise unless outputs are some of `OUTPUTS`, each once.

    Raises:
        ValueError: naming the one that is not.
    """
    for output in outputs:
        check_choice("outputs", output, OUTPUTS)
    if not outputs or len(set(outputs)) != len(outputs):
        raise ValueError(f"outputs must name at least one of {', '.join(OUTPUTS)}, each once; got {list(outputs)}")


@torch.no_grad()
def render_layers(
    renderer: Renderer,
    view: View,
    following: View | None,
    outputs: Sequence[str],
    *,
    truth: Truth | None = None,
    chunk: int = 16384,
) -> dict[str, NDArray]:
    """Render one frame.

    Args:
        renderer: the model.
        view: the frame.
        following: the next frame, to which motion goes; None after the last.
        outputs: some of `OUTPUTS`.
        truth: gives the true picture (H, W, 3) of a view; needed for "compare".
        chunk: rays at a time.

    Returns:
        The arrays that the outputs need (see `LAYERS`): rgb and truth (H, W, 3) uint8, rounded to the nearest; opacity
        (H, W) float32; depth (H, W) float32, the expected distance along the ray in world units, 0 where nothing is;
        motion (H, W, 2) float32, pixels to the right and down to where the matter is in the next frame, camera motion
        included, NaN where there is none, where it was not found or after the last frame; deformation (H, W) float32,
        the expected distance between world and canonical position in world units, 0 where nothing is.

    Raises:
        ValueError: if an output is unknown, or needs a truth or a deformation that is not there.
    """
    check_outputs(outputs)
    layers = {layer for output in outputs for layer in LAYERS[output]}
    rendering = renderer.render_image(view.camera, view.time, chunk=chunk)
    arrays = {}
    if "rgb" in layers:
        arrays["rgb"] = _bytes(rendering.rgb)
    if "truth" in layers:
        if truth is None:
            raise ValueError("outputs: compare needs true pictures: a path through a split's frames, or an exact scene")
        arrays["truth"] = _bytes(truth(view))
    for name, values in (("opacity", rendering.opacity), ("depth", rendering.depth)):
        if name in layers:
            arrays[name] = values.float().cpu().numpy()
    if "motion" in layers:
        arrays["motion"] = _motion(renderer, view, following, rendering, chunk)
    if "deformation" in layers:
        arrays["deformation"] = deformation_magnitude(renderer, view.camera, view.time, chunk=chunk).cpu().numpy()
    return arrays


@torch.no_grad()
def deformation_magnitude(renderer: Renderer, camera: Camera, time: float, *, chunk: int = 16384) -> Tensor:
    """Expected distance between world and canonical position of the matter that each pixel shows.

        m = sum_i w_i |x_i - deformation(x_i, t)| / sum_i w_i

    Args:
        renderer: a model whose field has a deformation.
        camera: the view.
        time: in [0, 1].
        chunk: rays at a time.

    Returns:
        (H, W) float32 in world units, 0 where nothing is.

    Raises:
        ValueError: if the field has no deformation.
    """
    check_positive("chunk", chunk)
    rays, parts = camera.rays(time), []
    modes = [(module, module.training) for module in renderer.modules()]
    renderer.eval()
    try:
        for i in range(0, len(rays), chunk):
            part = rays[i : i + chunk]
            rendering = renderer(part)
            if "canonical_positions" not in rendering.output.extras:
                raise ValueError("outputs: deformation needs a model with a deformation, this one has none")
            positions = rendering.samples.locate(part)[0]
            lengths = (rendering.output.extras["canonical_positions"] - positions).norm(dim=-1)
            total = sum_along_rays(lengths, rendering.samples, rendering.weights)
            parts.append(safe_divide(total, rendering.opacity))
    finally:
        for module, mode in modes:
            module.training = mode
    return torch.cat(parts).reshape(camera.intrinsics.height, camera.intrinsics.width).float()


def _motion(renderer: Renderer, view: View, following: View | None, rendering: Rendering, chunk: int) -> NDArray:
    if following is None:
        return np.full((*rendering.opacity.shape, 2), np.nan, np.float32)
    vectors = motion_vectors(
        motion_model(renderer), view.camera, view.time, following.time, rendering.depth, rendering.opacity,
        other_camera=following.camera, min_opacity=MIN_OPACITY, chunk=chunk,
    )  # fmt: skip
    known = vectors.valid & (vectors.residual <= MAX_RESIDUAL)
    return torch.where(known[..., None], vectors.flow_2d, torch.nan).float().cpu().numpy()


def _bytes(picture: Tensor) -> NDArray[np.uint8]:
    # NaN would be rounded to black without a word.
    if not bool(picture.isfinite().all()):
        raise FloatingPointError("the rendered picture holds NaN or infinity")
    return (picture.detach().float().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
