"""Images of what is no colour: depth and magnitudes with their scale, motion with its wheel, errors."""

import math

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from dnerf.core.checks import check_choice, check_positive, check_shape

# Every 16th colour of matplotlib's maps (S. van der Walt, N. Smith, E. Firing, CC0); interpolated to within 0.03.
COLORMAPS = {
    "inferno": "000004 0b0724 210c4a 3d0965 57106e 71196e 8a226a a32c61 bc3754 d24644 e45a31 f1731d f98e09 fcac11 "
    "f9cb35 f2ea69 fcffa4",
    "viridis": "440154 48186a 472d7b 424086 3b528b 33638d 2c728e 26828e 21918c 1fa088 28ae80 3fbc73 5ec962 84d44b "
    "addc30 d8e219 fde725",
}

# Number of steps from one corner of the colour wheel to the next.
WHEEL = ((15, "ff0000", "ffff00"), (6, "ffff00", "00ff00"), (4, "00ff00", "00ffff"), (11, "00ffff", "0000ff"),
         (13, "0000ff", "ff00ff"), (6, "ff00ff", "ff0000"))  # fmt: skip

QUANTILES = (0.005, 0.995)  # of numbers, between which a scale lies that outliers do not stretch
UNKNOWN = 0.75  # Grey of pixels without a motion


def colorize(values: Tensor, low: float, high: float, colormap: str = "viridis") -> Tensor:
    """Colours (..., 3) in [0, 1] of numbers (...,) by a perceptually uniform map, "viridis" or "inferno".

    What lies outside [low, high] gets the nearer end's colour. Raises ValueError unless low < high, both finite.
    """
    check_choice("colormap", colormap, tuple(COLORMAPS))
    if not -math.inf < low < high < math.inf:
        raise ValueError(f"low and high must be finite with low < high, got {low} and {high}")
    rows = [list(bytes.fromhex(color)) for color in COLORMAPS[colormap].split()]
    colors = torch.tensor(rows, dtype=torch.float32, device=values.device) / 255
    position = ((values.float() - low) / (high - low)).clamp(0, 1) * (len(colors) - 1)
    below = position.long().clamp(max=len(colors) - 2)
    return torch.lerp(colors[below], colors[below + 1], (position - below)[..., None])


def value_range(values: Tensor, mask: Tensor) -> tuple[float, float]:
    """The range (low, high) that all but 0.5 % at either end of `values[mask]` lie in; NaN if the mask is empty."""
    counted = values[mask].double().sort().values
    if not len(counted):
        return math.nan, math.nan
    low, high = (counted[round(q * (len(counted) - 1))] for q in QUANTILES)
    return float(low), float(high)


def scaled_image(values: Tensor, opacity: Tensor, low: float, high: float, *, label: str = "") -> Tensor:
    """Colours of numbers on white, faded by opacity, with a bar on the right that says which number is which colour.

    Args:
        values: (H, W), for example depth in world units.
        opacity: (H, W) in [0, 1].
        low: number of the darkest colour.
        high: of the brightest.
        label: the quantity and its unit, written above the bar of (H, W + bar, 3) uint8 that is returned.
    """
    check_shape("values", values, ("H", "W"))
    check_shape("opacity", opacity, values.shape)
    image = 1 - opacity[..., None].float() * (1 - colorize(values, low, high))
    height = image.shape[0]
    font = _font(height)
    numbers = [low + (high - low) * k / 4 for k in range(5)]
    digits = max(0, 2 - math.floor(math.log10(high - low)))
    texts = [f"{number:.{min(digits, 6)}f}" for number in numbers]
    line = math.ceil(font.getbbox("0")[3])
    thickness, gap = max(height // 25, 4), max(height // 50, 3)
    text_width = math.ceil(max(font.getlength(text) for text in texts))
    width = max(thickness + 3 * gap + text_width, math.ceil(font.getlength(label)) + 2 * gap)
    width += (image.shape[1] + width) % 2  # even, as video wants it
    panel = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(panel)
    top, bottom = gap + (2 * line if label else line // 2), height - gap - line // 2 - 1
    ramp = colorize(torch.linspace(high, low, max(bottom - top, 1)), low, high)
    bar = (ramp[:, None].expand(-1, thickness, 3) * 255).round().byte().numpy()
    panel.paste(Image.fromarray(np.ascontiguousarray(bar)), (gap, top))
    draw.text((gap, gap), label, fill="black", font=font)
    for number, text in zip(numbers, texts):
        y = bottom - (bottom - top) * (number - low) / (high - low)
        draw.text((2 * gap + thickness, y), text, fill="black", font=font, anchor="lm")
    return _beside(image, panel)


def flow_colors(flow: Tensor, max_length: float) -> Tensor:
    """Colours (..., 3) in [0, 1] of motion: hue by direction, saturation by length; white at rest, grey if unknown.

    The wheel of Baker et al., "A database and evaluation methodology for optical flow" (ICCV 2007), as in their
    `colorcode.cpp`: right is red, down yellow, left cyan-blue, up violet; vectors beyond `max_length` are darkened.

    Args:
        flow: (..., 2) pixels to the right and down; NaN where unknown.
        max_length: length of the most saturated colour, > 0; ValueError otherwise.
    """
    if flow.shape[-1:] != (2,) or not max_length > 0:
        raise ValueError(
            f"flow must have shape (..., 2) and max_length be > 0, got {tuple(flow.shape)} and {max_length}"
        )
    wheel = _wheel().to(flow.device)
    known = flow.isfinite().all(-1)
    x, y = (torch.where(known, part, 0.0).float() / max_length for part in flow.unbind(-1))
    length = torch.hypot(x, y)[..., None]
    # -0.0 would put what moves to the right at the far end of the wheel; the ends differ by one step of 55.
    position = (torch.atan2(-y, -x) / math.pi + 1) / 2 * (len(wheel) - 1)
    below = position.long().clamp(0, len(wheel) - 1)
    color = torch.lerp(wheel[below], wheel[(below + 1) % len(wheel)], (position - below)[..., None])
    color = torch.where(length <= 1, 1 - length * (1 - color), 0.75 * color)
    return torch.where(known[..., None], color, UNKNOWN)


def flow_image(flow: Tensor, max_length: float) -> Tensor:
    """`flow_colors` of an image (H, W, 2) with the wheel and its length on the right, (H, W + key, 3) uint8."""
    check_shape("flow", flow, ("H", "W", 2))
    height = flow.shape[0]
    font = _font(height)
    text = f"{max_length:.3g} px"
    line, gap = math.ceil(font.getbbox("0")[3]), max(height // 50, 3)
    side = max(height // 5, 8)
    width = max(side, math.ceil(font.getlength(text))) + 2 * gap
    width += (flow.shape[1] + width) % 2
    span = torch.linspace(-max_length, max_length, side)
    wheel = torch.stack([span.expand(side, side), span[:, None].expand(side, side)], dim=-1)
    key = flow_colors(wheel, max_length)
    key[wheel.norm(dim=-1) > max_length] = 1.0
    panel = Image.new("RGB", (width, height), "white")
    panel.paste(Image.fromarray((key * 255).round().byte().numpy()), ((width - side) // 2, gap))
    ImageDraw.Draw(panel).text((width / 2, 2 * gap + side + line / 2), text, fill="black", font=font, anchor="mm")
    return _beside(flow_colors(flow, max_length), panel)


def error_map(prediction: Tensor, target: Tensor, max_error: float = 0.2) -> Tensor:
    """Each pixel's absolute error, averaged over channels, as a colour (H, W, 3) of "inferno": black is 0.

    Args:
        prediction: (H, W, 3) in [0, 1].
        target: same shape; ValueError otherwise.
        max_error: from which on an error gets the brightest colour, pale yellow, > 0; state it beside the image.
    """
    check_positive("max_error", max_error)
    if prediction.shape != target.shape or prediction.shape[-1:] != (3,):
        raise ValueError(
            "prediction and target must have one shape (H, W, 3), "
            f"got {tuple(prediction.shape)} and {tuple(target.shape)}"
        )
    error = (prediction.detach().float() - target.float()).abs().mean(-1)
    return colorize(error, 0.0, max_error, "inferno")


def _beside(image: Tensor, panel: Image.Image) -> Tensor:
    """An image (H, W, 3) in [0, 1] with a panel on its right, (H, W + panel, 3) uint8 on the CPU."""
    pixels = (image.detach().cpu().clamp(0, 1) * 255).round().byte()
    return torch.cat([pixels, torch.from_numpy(np.array(panel))], dim=1)


def _wheel() -> Tensor:
    """The 55 colours of the wheel, (55, 3) in [0, 1], truncated to 8 bits as the original's integers are."""
    rows = []
    for steps, start, end in WHEEL:
        first, last = (list(bytes.fromhex(color)) for color in (start, end))
        for i in range(steps):
            part = 255 * i // steps
            rows.append([part if b > a else 255 - part if b < a else a for a, b in zip(first, last)])
    return torch.tensor(rows, dtype=torch.float32) / 255


def _font(height: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=min(max(height / 22, 9), 22))
