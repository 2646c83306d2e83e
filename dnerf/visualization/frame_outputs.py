"""One frame of a film as arrays: colour, depth, opacity, motion, deformation, normals, truth."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dnerf.core.backgrounds import ConstantBackground
from dnerf.core.cameras import Camera
from dnerf.core.checks import check_choice, check_positive
from dnerf.core.compositing import Rendering, safe_divide, sum_along_rays
from dnerf.fields.normals import NormalField, normals_of_image
from dnerf.motion import motion_model, motion_vectors
from dnerf.rendering.renderer import Renderer
from dnerf.visualization.video import to_uint8
from dnerf.visualization.views import View

# The arrays that each output is made of.
LAYERS: dict[str, tuple[str, ...]] = {
    "rgb": ("rgb",), "depth": ("depth", "opacity"), "opacity": ("opacity",), "motion": ("motion",),
    "deformation": ("deformation", "opacity"), "normals": ("normals", "opacity"), "compare": ("rgb", "truth"),
}  # fmt: skip

OUTPUTS = tuple(LAYERS)

Truth = Callable[[View], Tensor]


def check_outputs(outputs: Sequence[str]) -> None:
    """Raise ValueError unless outputs are some of `OUTPUTS`, each once."""
    for output in outputs:
        check_choice("outputs", output, OUTPUTS)
    if not outputs or len(set(outputs)) != len(outputs):
        raise ValueError(f"outputs must name at least one of {', '.join(OUTPUTS)}, each once; got {list(outputs)}")


@torch.no_grad()
def render_layers(
    renderer: Renderer, view: View, following: View | None, outputs: Sequence[str], *, truth: Truth | None = None,
    chunk: int = 16384, unit: float = 1.0,
) -> dict[str, NDArray]:  # fmt: skip
    """Render one frame.

    Args:
        following: the next frame, to which motion goes; None after the last.
        truth: gives the true image (H, W, 3) of a view; needed for "compare".
        unit: world units in one of those that lengths are given in.

    Returns:
        The arrays that the outputs need (see `LAYERS`), and max_opacity (), the largest opacity of the frame. rgb and
        truth (H, W, 3) uint8, rounded to the nearest. opacity (H, W) float32. depth (H, W) float32, the expected
        distance along the ray (not the z-depth), 0 where nothing is. motion (H, W, 2) float32, pixels to
        the right and down to where the surface is in the next frame, camera motion included; NaN where there is none,
        where it is unknown or not found, and after the last frame. deformation (H, W) float32, see
        `deformation_magnitude`. normals (H, W, 3) float32, see `normals_image`.

    Raises:
        ValueError: if an output is unknown, or needs a truth or a deformation that is not there.
    """
    check_outputs(outputs)
    layers = {layer for output in outputs for layer in LAYERS[output]}
    rendering = renderer.render_image(view.camera, view.time, chunk=chunk)
    arrays: dict[str, NDArray] = {"max_opacity": rendering.opacity.max().float().cpu().numpy()}
    if "rgb" in layers:
        arrays["rgb"] = _bytes(rendering.rgb)
    if "truth" in layers:
        if truth is None:
            raise ValueError("outputs: compare needs true images: a path through a split's frames, or an exact scene")
        arrays["truth"] = _bytes(truth(view))
    for name, values in (("opacity", rendering.opacity), ("depth", rendering.depth / unit)):
        if name in layers:
            arrays[name] = values.float().cpu().numpy()
    if "motion" in layers:
        arrays["motion"] = _motion(renderer, view, following, rendering, chunk)
    if "deformation" in layers:
        moved = deformation_magnitude(renderer, view.camera, view.time, chunk=chunk) / unit
        arrays["deformation"] = moved.cpu().numpy()
    if "normals" in layers:
        arrays["normals"] = normals_image(renderer, view.camera, view.time, chunk=chunk).cpu().numpy()
    return arrays


@torch.no_grad()
def deformation_magnitude(renderer: Renderer, camera: Camera, time: float, *, chunk: int = 16384) -> Tensor:
    """Expected distance between world and canonical position of what each pixel shows, (H, W) float32 in world units.

        m = sum_i w_i |x_i - deformation(x_i, t)| / sum_i w_i, 0 where nothing is

    Raises ValueError if the field has no deformation.
    """
    check_positive("chunk", chunk)
    rays, parts = camera.rays(time), []
    with renderer.evaluating():
        for i in range(0, len(rays), chunk):
            part = rays[i : i + chunk]
            rendering = renderer(part)
            if "canonical_positions" not in rendering.output.extras:
                raise ValueError("outputs: deformation needs a model with a deformation, this one has none")
            positions = rendering.samples.locate(part)[0]
            lengths = (rendering.output.extras["canonical_positions"] - positions).norm(dim=-1)
            total = sum_along_rays(lengths, rendering.samples, rendering.weights)
            parts.append(safe_divide(total, rendering.opacity))
    return torch.cat(parts).reshape(camera.intrinsics.height, camera.intrinsics.width).float()


def normals_image(renderer: Renderer, camera: Camera, time: float, *, chunk: int = 16384) -> Tensor:
    """Unit normals (H, W, 3) float32, in world axes, of what each pixel shows: the mean by weight, 0 where nothing is.

    Raises ValueError for a field that is not differentiable to positions.
    """
    shown = Renderer(
        NormalField(renderer.field), renderer.sampler, ConstantBackground("black"),
        stop_transmittance=renderer.stop_transmittance, quadrature=renderer.quadrature,
    )  # fmt: skip
    rendering = shown.to(renderer.device).render_image(camera, time, chunk=chunk)
    return normals_of_image(rendering.rgb, rendering.opacity).float()


def _motion(renderer: Renderer, view: View, following: View | None, rendering: Rendering, chunk: int) -> NDArray:
    if following is None:
        return np.full((*rendering.opacity.shape, 2), np.nan, np.float32)
    vectors = motion_vectors(
        motion_model(renderer), view.camera, view.time, following.time, rendering.depth, rendering.opacity,
        other_camera=following.camera, chunk=chunk,
    )  # fmt: skip
    return torch.where(vectors.found[..., None], vectors.flow_2d, torch.nan).float().cpu().numpy()


def _bytes(image: Tensor) -> NDArray[np.uint8]:
    if not bool(image.isfinite().all()):
        raise FloatingPointError("the rendered image holds NaN or infinity")
    return to_uint8(image).cpu().numpy()
