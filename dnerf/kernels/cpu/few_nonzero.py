"""numba version of `few_nonzero`."""

from typing import Any

import torch
from torch import Tensor

from ..few_nonzero import WORD
from .launch import BORROWS, kernel


def few_nonzero(flat: Tensor) -> Tensor:
    whole = len(flat) // WORD * WORD
    words, entries = flat[:whole].view(torch.int64).numpy(), flat.numpy()
    out = torch.empty(WORD * (_count(words) + 1), dtype=torch.int64)
    return out[: _find(words, entries, out.numpy())]


# One thread: starting a second one takes as long as this.
@kernel(parallel=False, **BORROWS)
def _count(words: Any) -> int:
    """How many words are not zero."""
    count = 0
    for i in range(len(words)):
        count += words[i] != 0
    return count


@kernel(parallel=False, **BORROWS)
def _find(words: Any, entries: Any, out: Any) -> int:
    """The numbers of the true entries, and how many there are; without a branch inside words."""
    count = 0
    for i in range(len(words)):
        if words[i] != 0:
            for k in range(WORD * i, WORD * i + WORD):
                out[count] = k
                count += entries[k]
    for k in range(WORD * len(words), len(entries)):
        out[count] = k
        count += entries[k]
    return count
