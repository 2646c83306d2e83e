"""Finding the few true entries of large masks."""

import torch
from torch import Tensor

from .backend import choose, run_compiled

WORD = 8  # bytes that are looked at together


@torch.no_grad()
def few_nonzero(mask: Tensor) -> Tensor:
    """As `mask.reshape(-1).nonzero()[:, 0]`, several times quicker where few are true.

    Args:
        mask: bool, of any shape.

    Returns:
        (K,) int64 flat places of the true entries, in order.

    Raises:
        ValueError: for a mask that is not bool.
    """
    if mask.dtype != torch.bool:
        raise ValueError(f"mask must be bool, got {mask.dtype}")
    flat = mask.contiguous().view(-1)
    if flat.storage_offset() % WORD:
        flat = flat.clone()
    if flat.is_cpu and choose(flat.new_empty(0, dtype=torch.float32)) == "numba":
        return run_compiled("few_nonzero", "few_nonzero", flat)
    return few_nonzero_reference(flat)


def few_nonzero_reference(flat: Tensor) -> Tensor:
    """`few_nonzero` of a flat mask whose memory begins at a whole word, in plain torch."""
    whole = len(flat) // WORD * WORD
    words = flat[:whole].view(torch.int64).nonzero()
    bytes_of_words = (words * WORD + torch.arange(WORD, device=flat.device)).view(-1)
    candidates = torch.cat([bytes_of_words, torch.arange(whole, len(flat), device=flat.device)])
    return candidates[flat[candidates]]
