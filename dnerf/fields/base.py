"""What a radiance field is: density and colour at positions and times."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from dnerf.compositing import FieldOutput
from dnerf.rays import Rays

MOST_AT_ONCE = 1 << 17  # places that `ask_along` asks in one go: bounds the memory, in haze
PAD_TO = 2048  # places: matrix libraries compile code for every new number of rows


class RadianceField(nn.Module, ABC):
    """Density and colour of light at world positions and times."""

    @abstractmethod
    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) >= 0 in 1 / world unit at positions (..., 3) and times (...,) in [0, 1]."""

    @abstractmethod
    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density and colour.

        Args:
            positions: (..., 3) in world units.
            directions: (..., 3) unit viewing directions, from the eye into the scene.
            times: (...,) in [0, 1].

        Returns:
            `FieldOutput` with density (...,) and rgb (..., 3) in [0, 1].
        """

    def along(self, rays: Rays, ray_indices: Tensor, distances: Tensor) -> FieldOutput:
        """What `forward` says at distances (N,) along the rays with numbers (N,) int64, perhaps without extras."""
        return self(*rays.places(ray_indices, distances))

    def _without_contents(self) -> ValueError:
        return ValueError(f"{type(self).__name__} has no contents that say all about a place (num_contents is 0)")

    def _check_contents(self, contents: Tensor, times: Tensor) -> None:
        if not self.num_contents:
            raise self._without_contents()
        if contents.shape[-1:] != (self.num_contents,):
            raise ValueError(f"contents must have shape (..., {self.num_contents}), got {tuple(contents.shape)}")
        if times.ndim and times.shape != contents.shape[:-1]:
            raise ValueError(
                f"times must have shape () or {tuple(contents.shape[:-1])} as the contents, got {tuple(times.shape)}"
            )

    @property
    def num_contents(self) -> int:
        """How many numbers say all about a place, see `contents`; 0 if none do, as where directions matter."""
        return 0

    @property
    def has_changes(self) -> bool:
        """Whether contents say all but what `changes` adds to them; False for a field without contents."""
        return False

    def contents(self, positions: Tensor) -> Tensor:
        """All that the field knows of positions (..., 3): numbers (..., C), about linear where the field is smooth.

        All but `changes`, if it has any (`has_changes`).

        Raises:
            ValueError: for a field without such numbers (`num_contents` is 0), or positions of another shape.
        """
        raise self._without_contents()

    def from_contents(self, contents: Tensor, times: Tensor) -> FieldOutput:
        """What `forward` says of places, from their contents (..., C), at times (...,) or one time () for all.

        Without `changes`, if it has any.

        Raises:
            ValueError: for a field without contents, or shapes that do not fit.
        """
        raise self._without_contents()

    def series_at(self, time: float) -> tuple[Tensor, float] | None:
        """How contents add up at a time in [0, 1], if they are 4 K terms of density, red, green and blue in turn.

        Returns:
            Factors w (K,) and a shift s such that density is `exp(min(w . terms + s, 15))` and a colour
            `sigmoid(w . terms)`, `changes` added to the products; None for a field that shows its contents in another
            way, or has none.
        """
        return None

    def changes(self, positions: Tensor, times: Tensor) -> Tensor:
        """What is added at positions (..., 3) and times (...,) to what terms sum up to, see `series_at`: (..., 4).

        Raises:
            ValueError: for a field of which contents say all, or that has none (`has_changes` is False).
        """
        raise ValueError(f"{type(self).__name__} has no changes beside its contents (has_changes is False)")

    def finished(self) -> "RadianceField":
        """The field to ask once nothing is learnt any more; itself, unless something can be kept between frames."""
        return self

    def at_time(self, time: float, extent: Tensor | None = None) -> "RadianceField":
        """The field to ask while a frame of one time is rendered; itself, unless something can be kept for it.

        Args:
            time: in [0, 1]; what is returned may be asked at no other.
            extent: (2, 3) box in world units beyond which it will hardly be asked, if that is known.
        """
        return self


def ask_along(
    field: RadianceField, rays: Rays, ray_indices: Tensor, distances: Tensor, *, pad_to: int = PAD_TO
) -> FieldOutput:
    """Density (N,) and rgb (N, 3) of a field along rays, at most `MOST_AT_ONCE` places at a time, without extras.

    Args:
        field: what is asked.
        rays: R rays.
        ray_indices: (N,) int64, the ray of each place.
        distances: (N,) along it, in world units.
        pad_to: a multiple of so many places is asked.
    """
    count = len(distances)
    padding = -count % pad_to if count else 0
    if padding:
        ray_indices, distances = (torch.cat([x, x[-1:].expand(padding)]) for x in (ray_indices, distances))
    parts = [
        field.along(rays, *part)
        for part in zip(ray_indices.split(MOST_AT_ONCE), distances.split(MOST_AT_ONCE), strict=True)
    ]
    density, rgb = (torch.cat(x) if len(x) > 1 else x[0] for x in zip(*((p.density, p.rgb) for p in parts)))
    return FieldOutput(density[:count], rgb[:count])
