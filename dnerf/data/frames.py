"""Images of a moving scene held as uint8, each with its camera and time."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from dnerf.core.backgrounds import parse_color
from dnerf.core.cameras import Camera, Intrinsics, camera_rays
from dnerf.core.checks import check_shape
from dnerf.core.frame_intrinsics import FrameIntrinsics
from dnerf.core.rays import Rays
from dnerf.data.pixel_layout import PixelLayout, empty_images

RIGID_TOLERANCE = 1e-3


def composite_on(rgba: Tensor, background: Tensor) -> Tensor:
    """Put premultiplied colour (..., 4) on a background (..., 3), all in [0, 1]: `rgb + (1 - alpha) background`."""
    if rgba.shape[-1:] != (4,) or background.shape[-1:] != (3,):
        raise ValueError(
            "rgba and background must have shapes (..., 4) and (..., 3), "
            f"got {tuple(rgba.shape)} and {tuple(background.shape)}"
        )
    return rgba[..., :3] + (1 - rgba[..., 3:]) * background


def is_rigid(poses: Tensor) -> Tensor:
    """Whether poses (..., 4, 4) are finite, with a rotation (to 1e-3) and the last row 0 0 0 1; (...) bool."""
    rotation = poses[..., :3, :3]
    identity = torch.eye(3, dtype=poses.dtype, device=poses.device)
    deviation = (rotation @ rotation.mT - identity).abs().amax(dim=(-2, -1))
    last_row = (poses[..., 3, :] - torch.tensor([0.0, 0, 0, 1], dtype=poses.dtype, device=poses.device)).abs()
    # Comparisons with NaN are false, so a NaN anywhere in the rotation or the last row is refused as well.
    proper = (deviation <= RIGID_TOLERANCE) & (torch.linalg.det(rotation) > 0)
    return proper & (last_row.amax(-1) <= RIGID_TOLERANCE) & poses.isfinite().all(-1).all(-1)


@dataclass(frozen=True, eq=False, init=False)
class Frames:
    """F images of one scene, each with a camera-to-world pose, intrinsics and a time.

    With four channels the colour is **premultiplied** by alpha, rounded once to 8 bits, so that an image on
    background b is `images[..., :3] / 255 + (1 - images[..., 3] / 255) b`. Memory is that of `images`: 200 frames
    of 400 x 400 with alpha take 128 MB.

    Args:
        intrinsics: of all frames, or F of them.

    Raises:
        ValueError: if shapes or types do not fit, a pose is not rigid or a time lies outside [0, 1].
    """

    images: Tensor  # (F, H, W, C) uint8, C = 3 (opaque) or 4 (premultiplied alpha); (P, C) in a row if sizes differ
    poses: Tensor  # (F, 4, 4) float32, camera-to-world, rigid, OpenGL axes
    times: Tensor  # (F,) float32 in [0, 1]
    intrinsics: tuple[Intrinsics, ...]  # one per frame, with its width and height; equal ones are stored once
    near: float  # z-depth where rays begin, in world units
    far: float  # z-depth where rays end
    background: str | Sequence[float] | None  # name or 3 numbers behind opaque images (C = 3); None if unknown
    names: tuple[str, ...]  # F names for messages and files, or none
    is_known: Tensor | None  # (P,) bool, pixels that count, see `layout`; None for all
    layout: PixelLayout = field(init=False, repr=False)
    _lenses: FrameIntrinsics = field(init=False, repr=False)

    def __init__(
        self, images: Tensor, poses: Tensor, times: Tensor, intrinsics: Intrinsics | Sequence[Intrinsics],
        near: float = 2.0, far: float = 6.0, background: str | Sequence[float] | None = None,
        names: tuple[str, ...] = (), is_known: Tensor | None = None,
    ) -> None:  # fmt: skip
        check_shape("times", times, ("F",))
        if not len(times):
            raise ValueError("images must be of at least one frame, got none")
        each = [intrinsics] * len(times) if isinstance(intrinsics, Intrinsics) else list(intrinsics)
        if len(each) != len(times):
            raise ValueError(f"intrinsics must be one, or {len(times)} as there are times, got {len(each)}")
        lenses = FrameIntrinsics(each, images.device)
        values = {
            "images": images, "poses": poses, "times": times, "intrinsics": lenses.each, "near": near, "far": far,
            "background": background, "names": names, "is_known": is_known, "_lenses": lenses,
            "layout": PixelLayout([(lens.height, lens.width) for lens in lenses.each], images.device),
        }  # fmt: skip
        for name, value in values.items():
            object.__setattr__(self, name, value)
        self._check()

    def _check(self) -> None:
        num_frames, shared = len(self), self.layout.shared
        shape = (self.num_pixels, "3 or 4") if shared is None else (num_frames, *shared, "3 or 4")
        check_shape("images", self.images, shape)
        if (channels := self.images.shape[-1]) not in (3, 4):
            raise ValueError(f"images must have shape (..., 3 or 4), got {tuple(self.images.shape)}")
        check_shape("poses", self.poses, (num_frames, 4, 4))
        for name, dtype in (("images", torch.uint8), ("poses", torch.float32), ("times", torch.float32)):
            if getattr(self, name).dtype != dtype:
                raise ValueError(f"{name} must be {dtype}, got {getattr(self, name).dtype}")
        if not self.images.is_contiguous():
            raise ValueError("images must be contiguous, for pixels to be gathered without a copy")
        rigid = is_rigid(self.poses)
        if not bool(rigid.all()):
            raise ValueError(f"poses must be rigid, pose {int((~rigid).nonzero()[0])} is not")
        outside = ~((self.times >= 0) & (self.times <= 1))
        if bool(outside.any()):
            raise ValueError(f"times must be in [0, 1], got {float(self.times[outside][0])}")
        if self.background is not None:
            if channels == 4:
                raise ValueError("background must be None for images with alpha, got a colour")
            parse_color(self.background)
        if self.names and len(self.names) != num_frames:
            raise ValueError(f"names must be {num_frames} or none, got {len(self.names)}")
        if self.is_known is not None:
            check_shape("is_known", self.is_known, (self.num_pixels,))
            counts = [known.any() for i in range(num_frames) if (known := self.known(i)) is not None]
            empty = (~torch.stack(counts)).nonzero()[:, 0].tolist()
            if empty:
                name = self.names[empty[0]] if self.names else empty[0]
                raise ValueError(f"is_known must leave a pixel of every frame, frame {name} has none: take it out")
        self.camera(0)  # checks the planes

    def __len__(self) -> int:
        return len(self.intrinsics)

    @property
    def has_alpha(self) -> bool:
        """Whether the images have an alpha channel and so premultiplied colour."""
        return self.images.shape[-1] == 4

    @property
    def num_pixels(self) -> int:
        """Number of pixels of all frames together; `pixels` takes indices below it."""
        return self.layout.num_pixels

    @property
    def shared_intrinsics(self) -> Intrinsics | None:
        """The intrinsics of all frames; None if they differ."""
        return self._lenses.shared

    def camera(self, index: int) -> Camera:
        """The camera of one frame."""
        return Camera(self.intrinsics[index], self.poses[index], self.near, self.far)

    @property
    def is_transparent(self) -> bool:
        """Whether any pixel is not opaque; an alpha channel that is 255 everywhere says nothing of what lies behind."""
        return self.has_alpha and any(bool((self.stored_image(i)[..., 3] < 255).any()) for i in range(len(self)))

    def stored_image(self, index: int) -> Tensor:
        """One image as it is stored, (H, W, 3 or 4) uint8; a view."""
        if self.layout.shared is not None:
            return self.images[index]
        start, (height, width) = self.layout.starts[:-1][index], self.layout.sizes[index]
        return self.images[start : start + height * width].view(height, width, -1)

    def image(self, index: int, background: Sequence[float] | Tensor | None = None) -> Tensor:
        """One image on a background, (H, W, 3) float32 in [0, 1].

        Images with alpha need a background (3,) in [0, 1], as the renderer has it (else ValueError); opaque ones ignore
        it.
        """
        pixels = self.stored_image(index).float() / 255
        if not self.has_alpha:
            return pixels
        if background is None:
            raise ValueError("background must be three numbers in [0, 1] for images with alpha, got None")
        color = torch.as_tensor(background, dtype=torch.float32, device=self.images.device)
        check_shape("background", color, (3,))
        return composite_on(pixels, color)

    def pixels(self, indices: Tensor) -> tuple[Rays, Tensor]:
        """Rays (B), each at its frame's time, and premultiplied colours (B, 4) float32 (alpha 1 if opaque) of any
        pixels.

        Indices (B,) int64 in [0, num_pixels), on the images' device, count frame after frame, each row by row, see
        `layout`; ValueError for another shape or type.
        """
        check_shape("indices", indices, ("B",))
        if indices.dtype != torch.int64:
            raise ValueError(f"indices must be int64, got {indices.dtype}")
        rgba = self.images.view(-1, self.images.shape[-1]).index_select(0, indices).float() / 255
        if not self.has_alpha:
            rgba = torch.nn.functional.pad(rgba, (0, 1), value=1.0)
        frames, rows, columns = self.layout.locate(indices)
        rays = camera_rays(
            self._lenses.of(frames), self.poses.index_select(0, frames), columns, rows,
            times=self.times.index_select(0, frames), near=self.near, far=self.far,
        )  # fmt: skip
        return rays, rgba

    def counted(self, indices: Tensor) -> Tensor:
        """Pixels (B,) int64 of which those that do not count are replaced by others among them, which come again."""
        if self.is_known is None:
            return indices
        known = self.is_known[indices]
        first = (~known).byte().argsort(stable=True)  # those that count
        turns = torch.arange(len(indices), device=indices.device) % known.sum().clamp(min=1)
        return torch.where(known, indices, indices[first[turns]])

    def known(self, index: int) -> Tensor | None:
        """Which pixels (H, W) of one frame count; None for all."""
        if self.is_known is None:
            return None
        return self.is_known[self.layout.starts[index] : self.layout.starts[index + 1]].view(self.layout.sizes[index])

    def subset(self, indices: Sequence[int]) -> "Frames":
        """The frames with the given indices, in that order (a copy); ValueError for none, or one that is not there."""
        if not len(indices) or not all(-len(self) <= i < len(self) for i in indices):
            raise ValueError(f"indices must name some of {len(self)} frames, got {list(indices)[:8]}")
        rows = [i % len(self) for i in indices]
        chosen = torch.as_tensor(rows, device=self.poses.device)
        names = tuple(self.names[i] for i in rows) if self.names else ()
        known = [part.flatten() for i in rows if (part := self.known(i)) is not None]
        return replace(
            self, images=self._images_of(rows), poses=self.poses[chosen], times=self.times[chosen], names=names,
            intrinsics=tuple(self.intrinsics[i] for i in rows),
            is_known=torch.cat(known) if known else None,
        )  # fmt: skip

    def _images_of(self, rows: Sequence[int]) -> Tensor:
        sizes = [self.layout.sizes[i] for i in rows]
        images, parts = empty_images(sizes, self.images.shape[-1], device=self.images.device)
        for i, part in zip(rows, parts):
            part.copy_(self.stored_image(i))
        return images

    def to(self, device: str | torch.device) -> "Frames":
        """The same frames on another device."""
        known = None if self.is_known is None else self.is_known.to(device)
        images, poses, times = (x.to(device) for x in (self.images, self.poses, self.times))
        return replace(self, images=images, poses=poses, times=times, is_known=known)
