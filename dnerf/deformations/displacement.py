"""The D-NeRF deformation: an MLP of position and time displaces each sample."""

from collections.abc import Sequence

import torch
from torch import Tensor

from dnerf.core.geometry import move_by_twists
from dnerf.deformations.base import Deformation, check_positions_times
from dnerf.nn.encodings import SinusoidalEncoding, TimeEncoding
from dnerf.nn.mlp import MLP
from dnerf.nn.parameter_groups import DeclaresGroups, ParameterGroup, network_groups


class DisplacementDeformation(Deformation, DeclaresGroups):
    """Displacement by an MLP: x' = x + (t - t0) f(x, t), the identity at the canonical time by construction.

    Source: D-NeRF (arXiv 2011.13961) eq. 3. D-NeRF branches in code on t = 0, which breaks the map's continuity and
    wants one time per batch; the factor (t - t0) gives the same identity smoothly and per sample. With
    `canonical_time=None` there is no factor and no canonical time: x' = x + f(x, t).

    Args:
        num_layers: hidden layers of the MLP.
        hidden_features: their width.
        skips: hidden layers that see the encoded input again.
        position_frequencies: octaves of the positions' sinusoidal encoding.
        time_frequencies: octaves of the times' encoding.
        canonical_time: t0 in [0, 1], or None.
        window_end: fraction of training at which all octaves of position are in, see `SinusoidalEncoding`.
        time_embeddings: learnt embeddings of time, half as many as frames at most (`TimeEncoding`); 0 for none.

    Raises:
        ValueError: if the canonical time lies outside [0, 1], for one embedding, or a number of features out of range.
    """

    NUM_OUTPUTS = 3  # of the MLP

    def __init__(
        self, num_layers: int = 8, hidden_features: int = 256, skips: Sequence[int] = (), *,
        position_frequencies: int = 10, time_frequencies: int = 10, canonical_time: float | None = 0.0,
        window_end: float | None = None, time_embeddings: int = 0,
    ) -> None:  # fmt: skip
        super().__init__()
        if canonical_time is not None and not 0 <= canonical_time <= 1:
            raise ValueError(f"canonical_time must be in [0, 1] or None, got {canonical_time}")
        self.canonical_time = canonical_time
        self.encode_positions = SinusoidalEncoding(3, position_frequencies, window_end=window_end)
        self.encode_times = TimeEncoding(time_frequencies, time_embeddings)
        self.mlp = MLP(
            self.encode_positions.out_features + self.encode_times.out_features, hidden_features, num_layers,
            out_features=self.NUM_OUTPUTS, skips=skips, zero_output=True,
        )  # fmt: skip

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of world positions (..., 3) at times (...,)."""
        check_positions_times(positions, times)
        encoded = torch.cat(
            [*self.encode_positions.parts(positions), *self.encode_times.parts(times[..., None])], dim=-1
        )
        motion = self.mlp(encoded).to(positions.dtype)
        if self.canonical_time is not None:
            motion = motion * (times[..., None] - self.canonical_time)
        return self._moved(positions, motion)

    def parameter_groups(self) -> list[ParameterGroup]:
        """All in "deformation", but for the last layer, in "deformation_output": small steps where they are felt."""
        return network_groups(self, "deformation", self.mlp.output)

    def _moved(self, positions: Tensor, motion: Tensor) -> Tensor:
        """Positions (..., 3) moved by what the MLP says, (..., NUM_OUTPUTS)."""
        return positions + motion


class SE3Deformation(DisplacementDeformation):
    """A rigid motion for each sample by an MLP: x' = exp((t - t0) f(x, t)) x, f a twist about the origin.

    Where a part moves as a rigid body its twist is the same everywhere, which is less to learn than its displacement.

    Source: Nerfies (arXiv 2011.12948) section 3.2 (twists there have a norm and an axis apart). Arguments and errors
    as of `DisplacementDeformation`.
    """

    NUM_OUTPUTS = 6

    def _moved(self, positions: Tensor, motion: Tensor) -> Tensor:
        return move_by_twists(motion, positions)
