"""Small things that training's pictures show and the model does not: patches of wrong pixels, as rays."""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from dnerf.backgrounds import parse_color
from dnerf.data.frames import Frames
from dnerf.error_map import UNSEEN, ErrorMap
from dnerf.trajectories import Sighting

MATTER = 0.5  # opacity, or difference from the background, from which a pixel shows matter
MIN_PIXELS = 4  # of the small picture, of a sighting
MOST_SIGHTINGS = 10  # in a frame
ROUNDS = 40  # by as many pixels may a sighting be long, the way through its own pixels
BESIDE = 0.2  # most of the pixels around a sighting that show matter, if it is alone
LONG = 3.0  # times its width: no body, but an edge


def small_wrong_things(
    frames: Frames, error_map: ErrorMap, *, error: float, resolution: int, max_share: float
) -> list[list[Sighting]]:
    """What small things each frame shows where training's pictures are wrong, largest first.

    Args:
        frames: F of the training.
        error_map: of them.
        error: mean squared error of colours from which a block of pixels is wrong.
        resolution: about which pictures are reduced to, in pixels along the longer side.
        max_share: of a picture, that a sighting may fill.

    Returns:
        F lists, in the order of the frames.
    """
    height, width = frames.images.shape[1:3]
    side = max(1, round(max(height, width) / resolution))
    rows, columns = height // side, width // side
    is_wrong = (error_map.errors > error) & (error_map.errors < UNSEEN)
    # A block knows a pixel or two: what is wrong in it may reach into its neighbours.
    is_wrong = max_pool2d(is_wrong.float(), 3, 1, 1) > 0
    middles = [((torch.arange(n) + 0.5) * side).long() // error_map.block for n in (rows, columns)]
    found = []
    for number in range(len(frames)):
        image = frames.images[number, : rows * side, : columns * side].float() / 255
        small = avg_pool2d(image.permute(2, 0, 1)[None], side)[0].permute(1, 2, 0).cpu()
        matter = _opacity(small, frames) > MATTER
        wrong = is_wrong[number].cpu()[middles[0]][:, middles[1]] & matter
        found.append(_in_frame(frames, number, side, small[..., :3], matter, wrong, max_share))
    return found


def _in_frame(
    frames: Frames, number: int, side: int, colors: Tensor, matter: Tensor, wrong: Tensor, max_share: float
) -> list[Sighting]:
    labels = _labels(wrong)
    numbers, counts = labels[labels > 0].unique(return_counts=True)
    fits = (counts >= MIN_PIXELS) & (counts <= max_share * wrong.numel())
    largest = counts.masked_fill(~fits, 0).argsort(descending=True, stable=True)[: min(int(fits.sum()), MOST_SIGHTINGS)]
    pose = frames.poses[number].double().cpu().numpy()
    focal_x, focal_y, center_x, center_y = frames.intrinsics.lens
    found = []
    for index in largest.tolist():
        is_it = labels == numbers[index]
        places = is_it.nonzero().double()
        middle = places.mean(0)
        spread = torch.linalg.eigvalsh((places - middle).T @ (places - middle) / len(places))
        if spread[1] > LONG**2 * spread[0].clamp(min=1 / 12):
            continue
        row, column = ((middle + 0.5) * side - 0.5).tolist()
        direction = np.array([(column - center_x) / focal_x, -(row - center_y) / focal_y, -1.0])
        length = float(np.linalg.norm(direction))
        around = (max_pool2d(is_it[None].float(), 5, 1, 2)[0] > 0) & ~is_it
        color = colors[is_it].median(0).values
        found.append(
            Sighting(
                time=float(frames.times[number]),
                origin=pose[:3, 3],
                direction=pose[:3, :3] @ direction / length,
                angle=side * (len(places) / np.pi) ** 0.5 / focal_x / length,
                color=color.double().numpy(),
                is_alone=int((around & matter).sum()) <= BESIDE * int(around.sum()),
                pixels=_pixels(frames, number, is_it.nonzero() * side + side // 2),
            )
        )
    return found


def _pixels(frames: Frames, number: int, places: Tensor) -> np.ndarray:
    """Numbers, as `Frames.pixels` takes them, of rows and columns (P, 2) of a frame."""
    height, width = frames.images.shape[1:3]
    return ((number * height + places[:, 0]) * width + places[:, 1]).numpy()


def _opacity(small: Tensor, frames: Frames) -> Tensor:
    """Of pixels (h, w, 4) or, opaque, (h, w, 3): how much they differ from what is behind them."""
    if frames.has_alpha:
        return small[..., 3]
    behind = parse_color("white" if frames.background is None else frames.background)
    return (small - small.new_tensor(behind)).abs().amax(-1)


def _labels(mask: Tensor) -> Tensor:
    """Numbers (h, w) of what hangs together in a mask (h, w), corners included; 0 for what is not in it."""
    labels = torch.arange(1, mask.numel() + 1, dtype=torch.float32).view(1, *mask.shape) * mask
    for _ in range(ROUNDS):
        spread = max_pool2d(labels, 3, 1, 1) * mask
        if torch.equal(spread, labels):
            break
        labels = spread
    return labels[0].long()
