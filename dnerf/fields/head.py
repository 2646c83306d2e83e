"""A tiny head on features of places and times: density and colour."""

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_choice, check_positive, check_shape, check_within
from dnerf.core.compositing import FieldOutput, at_least_float32
from dnerf.core.schedules import Scheduled
from dnerf.core.spherical_harmonics import DEGREES, spherical_harmonics
from dnerf.deformations.base import check_positions_times
from dnerf.fields.activations import activate_density
from dnerf.fields.base import RadianceField, TimeDependence
from dnerf.kernels import series_sums
from dnerf.nn.mlp import MLP
from dnerf.nn.parameter_groups import DeclaresGroups, HasOutputLabels, ParameterGroup

# Of harmonics beside the constant, which stays one: this makes them orthonormal. All coefficients take steps of one
# size, and a colour's dependence on direction is best found more slowly than the colour.
VIEW_SCALE = 1 / math.sqrt(4 * math.pi)


class SpaceTimeFeatures(nn.Module, ABC):
    """Features of places at times, for a head to see beside a field's own."""

    out_features: int

    @abstractmethod
    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Features (..., n) at positions (..., 3) and times (...,) in [0, 1]."""


class HeadedField(RadianceField, TimeDependence, DeclaresGroups, HasOutputLabels, Scheduled):
    """A small MLP for density and colour, on features of several levels, finer and finer.

    Parts a scene does not need do not exist: no change with time without `temporal_terms` or `space_time`, no
    directions without `view_degree`.

    Args:
        num_levels: of the features.
        num_features: of each level.
        hidden_features: width of the head.
        num_layers: hidden layers of the head.
        temporal_terms: terms K of a cosine series in time, cos(k pi t) for k < K, that density and colour follow before
            their activations: folds and shading that change with motion. 1 for what is carried and never changes.
        space_time: features of place and time that the head sees, too: for what moves too fast, or in too many ways,
            for a deformation to follow. None for a head that does not see any.
        view_degree: degree, 0 to 4, of spherical harmonics of the direction that colour follows before its activation,
            beside the series in time: a ray sees one of these functions all along, so images cost hardly more than
            matte ones. None or 0 for matte.
        one_color: whether colour is the same everywhere, as of smoke; it may still follow time and direction. Then only
            density explains what is bright and what is dim, as in tomography.
        density_shift: added before the exponential that gives density; negative for a thin start.
        window_end: fraction of training, in (0, 1], at which every level is in; finer levels fade in one after the
            other, so that a deformation is first found by coarse shapes, whose gradients reach far (Nerfies, arXiv
            2011.12948, eq. 8, for grids). None for all levels from the start.

    Raises:
        ValueError: for sizes out of range.
    """

    def __init__(
        self, num_levels: int, num_features: int, *, hidden_features: int = 64, num_layers: int = 2,
        temporal_terms: int = 1, space_time: SpaceTimeFeatures | None = None, view_degree: int | None = None,
        one_color: bool = False, density_shift: float = -1.0, window_end: float | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        check_positive("temporal_terms", temporal_terms)
        check_choice("view_degree", view_degree or 0, DEGREES)
        check_within("window_end", window_end, "(0, 1]", or_none=True)
        self.num_features = num_features
        self.density_shift = density_shift
        self.window_end = window_end
        self.window = nn.Buffer((torch.arange(num_levels) == 0).float(), persistent=window_end is not None)
        self.space_time, self.one_color = space_time, one_color
        self.temporal_terms = temporal_terms
        self.view_degree = view_degree or 0
        self.orders = nn.Buffer(torch.arange(temporal_terms), persistent=False)
        in_features = num_features * num_levels + (0 if space_time is None else space_time.out_features)
        color_terms = temporal_terms + (self.view_degree + 1) ** 2 - 1
        self.head = MLP(in_features, hidden_features, num_layers, out_features=temporal_terms + 3 * color_terms)
        with torch.no_grad():  # a fresh series begins without the terms that change
            for part in self.head.output.parameters():  # type: ignore[union-attr]
                density, colors = self._series(part)
                density[1:], colors[:, 1:] = 0, 0

    @abstractmethod
    def _features(self, positions: Tensor, times: Tensor) -> Tensor:
        """Features (..., L F), level by level, at positions (..., 3) and times (...,)."""

    @property
    def is_static(self) -> bool:
        """Whether neither the head nor its series sees times."""
        return self.space_time is None and self.temporal_terms == 1

    def _series(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Of density (D, ...) and of colours (3, K, ...): parts of what the head has for each output."""
        density, colors = outputs.tensor_split([self.temporal_terms])
        return density, colors.unflatten(0, (3, -1))

    def parameter_groups(self) -> list[ParameterGroup]:
        """The networks in "head"; features, which wait long for their turn, are not among them."""
        return [ParameterGroup("head", tuple(self.head.parameters()))]

    def output_labels(self) -> dict[str, list[str]]:
        """What the rows of the head's last layer are coefficients of."""
        waves = [f"wave {order}" for order in range(self.temporal_terms)]
        harmonics = [f"harmonic {number}" for number in range(1, (self.view_degree + 1) ** 2)]
        colors = [f"{color} {term}" for color in ("red", "green", "blue") for term in waves + harmonics]
        labels = [f"density {wave}" for wave in waves] + colors
        return {"head.output.weight": labels, "head.output.bias": labels}

    def set_progress(self, progress: float) -> None:
        """Open the window to where training stands, `progress` in [0, 1]; no effect without a window."""
        if self.window_end is not None:
            open_levels(self.window, progress / self.window_end)

    @property
    def _input_scale(self) -> Tensor | None:
        """Of each column (n,) that the head sees: the window's of features; None for 1."""
        if self.window_end is None:
            return None
        scale = self.window.repeat_interleave(self.num_features)
        return nn.functional.pad(scale, (0, self.head.in_features - len(scale)), value=1)

    def _linear(self, positions: Tensor, times: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """What a linear layer makes of what the head's last one sees."""
        return self._last_layer(self._seen(positions, times), weight, bias)

    def _last_layer(self, seen: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        return nn.functional.linear(seen, weight, bias)

    def _seen(self, positions: Tensor, times: Tensor) -> Tensor:
        """What the head's last layer sees (..., n)."""
        features = self._features(positions, times)
        if self.space_time is not None:
            features = torch.cat([features, self.space_time(positions, times)], dim=-1)
        return self.head.before_output(features, self._input_scale)

    @property
    def _last(self) -> tuple[Tensor, Tensor]:
        """Weight and bias of the head's last layer; of one colour only the biases count."""
        assert self.head.output is not None
        weight, bias = self.head.output.weight, self.head.output.bias
        if self.one_color:
            weight = torch.cat([weight[: self.temporal_terms], torch.zeros_like(weight[self.temporal_terms :])])
        return weight, bias

    def _activated(self, raw: Tensor) -> Tensor:
        return activate_density(raw, "exp", self.density_shift)

    def _at(self, series: Tensor, times: Tensor) -> Tensor:
        """Values (..., n) of series (..., n K) at times (...,), or at one time ()."""
        if self.temporal_terms == 1:
            return series
        dtype = torch.promote_types(torch.promote_types(series.dtype, times.dtype), torch.float32)
        waves = self._waves(times.to(dtype))
        terms = series.to(dtype).unflatten(-1, (-1, self.temporal_terms))
        if times.ndim:
            return (terms * waves[..., None, :]).sum(-1)
        with torch.autocast(terms.device.type, enabled=False):
            return terms @ waves

    def _waves(self, times: Tensor) -> Tensor:
        """The series' cosines (..., K) at times (...,)."""
        return torch.cos(math.pi * self.orders.to(times.dtype) * times[..., None])

    def _density_series(self, positions: Tensor, times: Tensor) -> Tensor:
        """What the head says of density alone (..., K)."""
        check_positions_times(positions, times)
        if not self.view_degree:
            return self._linear(positions, times, *self._last)[..., : self.temporal_terms]
        # Colours have many terms.
        return self._linear(positions, times, *(self._series(part)[0] for part in self._last))

    def _values(self, positions: Tensor, directions: Tensor, times: Tensor) -> Tensor:
        """Density and colour (..., 4), before their activations, in float32 at least."""
        check_positions_times(positions, times)
        if self.view_degree:
            check_shape("directions", directions, positions.shape)
        raw = self._linear(positions, times, *self._last)
        if not self.view_degree:
            return at_least_float32(self._at(raw, times))
        with torch.autocast(raw.device.type, enabled=False):
            harmonics = spherical_harmonics(directions, self.view_degree)[..., 1:] * VIEW_SCALE
            basis = torch.cat([self._waves(times), harmonics], dim=-1)
            sums = series_sums(raw.reshape(-1, raw.shape[-1]), basis.reshape(-1, basis.shape[-1]))
        return sums.reshape(*times.shape, 4)

    def _at_one_time(self, outputs: Tensor, waves: Tensor) -> Tensor:
        """Rows of density, and of harmonics of colours in turn, of rows for all of the head's outputs."""
        density, colors = self._series(outputs)
        terms = torch.cat([density[None], colors[:, : len(waves)]])
        summed = torch.einsum("ckh,k->ch", terms, waves)
        harmonics = torch.cat([summed[1:, None], colors[:, len(waves) :] * VIEW_SCALE], dim=1)
        return torch.cat([summed[:1], harmonics.flatten(0, 1)])

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) at canonical positions (..., 3) and times (...,)."""
        return self._activated(self._at(self._density_series(positions, times), times)[..., 0])

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at canonical positions (..., 3), directions (..., 3) and times (...,)."""
        values = self._values(positions, directions, times)
        # Of all columns, then without the first: what lies in one row is several times quicker.
        return FieldOutput(density=self._activated(values[..., 0]), rgb=torch.sigmoid(values)[..., 1:])


def open_levels(window: Tensor, share: float) -> None:
    """Set what levels (L,) count for to where a share of a window's time is over: from coarse to fine, one is open."""
    opened = (len(window) - 1) * min(share, 1.0) - torch.arange(len(window), device=window.device) + 1
    window.copy_(0.5 * (1 - torch.cos(math.pi * opened.clamp(0, 1))))
