"""Fixed encodings of positions and times."""

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_positive, check_whole, check_within
from dnerf.core.geometry import check_last_axis
from dnerf.core.schedules import Scheduled

FRAMES_PER_EMBEDDING = 2


class FramesAware(ABC):
    """A module that gets to know the training frames before the first step."""

    @abstractmethod
    def see(self, times: Tensor, places: Tensor) -> None:
        """Adapt to the frames' times (F,) and their cameras' places (F, 3) in world units; what was learnt stays."""


class SinusoidalEncoding(nn.Module, Scheduled):
    """Sines and cosines of a value at doubling frequencies: (x, sin(2^k x), cos(2^k x)), k < num_frequencies.

    Source: NeRF (arXiv 2003.08934) eq. 4, without its factor pi, as D-NeRF's code has it. With
    `window_end`, frequency k fades in while training goes on (Nerfies, arXiv 2011.12948, eq. 8):
    w_k = (1 - cos(pi clamp(a - k, 0, 1))) / 2 with a = num_frequencies * progress / window_end.

    Args:
        num_dims: D, size of the last axis of the input.
        num_frequencies: number of octaves, >= 0.
        window_end: fraction of the training, in (0, 1], at which every frequency is fully in; None for no window.

    Raises:
        ValueError: for no dimensions or a window outside (0, 1].
    """

    def __init__(self, num_dims: int, num_frequencies: int, *, window_end: float | None = None) -> None:
        super().__init__()
        check_positive("num_dims", num_dims)
        check_positive("num_frequencies", num_frequencies, allow_zero=True)
        check_within("window_end", window_end, "(0, 1]", or_none=True)
        self.num_dims = num_dims
        self.num_frequencies = num_frequencies
        self.window_end = window_end
        self.out_features = num_dims * (2 * num_frequencies + 1)
        self.frequencies = nn.Buffer(2.0 ** torch.arange(num_frequencies), persistent=False)
        weights = torch.zeros(num_frequencies) if window_end is not None else torch.ones(num_frequencies)
        self.window = nn.Buffer(weights, persistent=window_end is not None)

    def set_progress(self, progress: float) -> None:
        """Open the window to where training stands, `progress` in [0, 1]; no effect without a window."""
        if self.window_end is None:
            return
        alpha = self.num_frequencies * min(progress / self.window_end, 1.0)
        octaves = torch.arange(self.num_frequencies, device=self.window.device)
        self.window.copy_(0.5 * (1 - torch.cos(math.pi * (alpha - octaves).clamp(0, 1))))

    def forward(self, values: Tensor) -> Tensor:
        """Encode (..., D) -> (..., D * (2 * num_frequencies + 1)), in the input's dtype."""
        return torch.cat(self.parts(values), dim=-1)

    def parts(self, values: Tensor) -> list[Tensor]:
        """What `forward` puts together, for callers who put more together in one go."""
        check_last_axis("values", values, self.num_dims)
        angles = (values[..., None, :] * self.frequencies.to(values.dtype)[:, None]).flatten(-2)
        waves = [torch.sin(angles), torch.cos(angles)]
        if self.window_end is not None:
            window = self.window.to(values.dtype).repeat_interleave(self.num_dims)
            waves = [wave * window for wave in waves]
        return [values, *waves]


class TimeEncoding(nn.Module, FramesAware):
    """Waves of a time, then a learnt time embedding: features evenly spaced in time, linear in between.

    Waves (`SinusoidalEncoding`) are smooth and say something of all times. What happens within a frame or two, as when
    a ball bounces, a network finds in them slowly, and more octaves ripple everywhere. An embedding is of its own time
    alone. Embeddings begin at zero and stay there at times that no frame has, if no loss says otherwise
    (`dnerf.losses.TimeEmbeddingLoss`). How many are in use depends on how many frames there are (`see`): a frame with
    an embedding of its own is explained by bending it by itself, not by what other frames show, too.

    Source: the latent codes of frames in Nerfies (arXiv 2011.12948) and DyNeRF (arXiv 2103.02597), here beside waves
    and defined between frames, too.

    Args:
        num_frequencies: octaves of the waves, >= 0.
        num_embeddings: K, from time 0 to time 1, all in use until `see` says otherwise; 0 for none, else at least 2.
        num_features: F of an embedding.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(self, num_frequencies: int, num_embeddings: int = 0, num_features: int = 4) -> None:
        super().__init__()
        if num_embeddings < 0 or num_embeddings == 1:
            raise ValueError(f"num_embeddings must be 0 or at least 2, got {num_embeddings}")
        check_whole("num_embeddings", num_embeddings, allow_zero=True)
        check_positive("num_features", num_features)
        self.waves = SinusoidalEncoding(1, num_frequencies)
        self.embeddings = nn.Parameter(torch.zeros(num_embeddings, num_features)) if num_embeddings else None
        if num_embeddings:
            self.num_used = nn.Buffer(torch.tensor(num_embeddings))
        self.out_features = self.waves.out_features + (num_features if num_embeddings else 0)

    @torch.no_grad()
    def see(self, times: Tensor, places: Tensor) -> None:
        """Use half as many embeddings as there are frames, and at most one for each time; what they know stays."""
        if self.embeddings is None:
            return
        wanted = min(len(times) // FRAMES_PER_EMBEDDING, len(times.unique()), len(self.embeddings))
        has_learnt = bool(self.embeddings.any())
        wanted = max(wanted, int(self.num_used) if has_learnt else 2, 2)
        if wanted != self.num_used:
            places = torch.linspace(0, 1, wanted, dtype=self.embeddings.dtype, device=self.embeddings.device)
            features = self._features(self.embeddings, places[:, None])
            self.num_used.fill_(wanted)
            self.embeddings[:wanted] = features

    def forward(self, times: Tensor) -> Tensor:
        """Encode times (..., 1) -> (..., 2 num_frequencies + 1 + F), in their dtype; those outside [0, 1] see its ends'
        features."""
        return torch.cat(self.parts(times), dim=-1)

    def parts(self, times: Tensor) -> list[Tensor]:
        """What `forward` puts together, for callers who put more together in one go."""
        waves = self.waves.parts(times)
        return waves if self.embeddings is None else [*waves, self._features(self.embeddings, times)]

    def roughness(self) -> Tensor:
        """The mean squared difference () between features of neighbouring embeddings in use; 0 without embeddings."""
        if self.embeddings is None:
            return self.waves.frequencies.new_zeros(())
        last = self.num_used - 1
        is_used = torch.arange(len(self.embeddings) - 1, device=last.device) < last
        return self.embeddings.diff(dim=0).square().mean(dim=1).mul(is_used).sum() / last

    def _features(self, embeddings: Tensor, times: Tensor) -> Tensor:
        last = self.num_used - 1
        places = times.clamp(0, 1) * last.to(times.dtype)
        # Of NaN: some embedding, and a share that is NaN.
        lower = torch.minimum(places.detach().long().clamp_(min=0), last - 1)
        before, after = (embeddings.index_select(0, (lower + i).flatten()) for i in (0, 1))
        shape = (*times.shape[:-1], embeddings.shape[1])
        return torch.lerp(before.view(shape).to(times.dtype), after.view(shape).to(times.dtype), places - lower)
