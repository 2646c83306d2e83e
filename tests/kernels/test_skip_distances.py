import itertools

import pytest
import torch
from kernels.backends import under
from kernels.test_march import grid

from dnerf.kernels import skip_distances
from dnerf.kernels.skip_distances import skip_distances_reference


@pytest.mark.parametrize("shape", [(2, 8, 8, 8), (1, 33, 17, 40), (3, 5, 64, 9)])
@pytest.mark.parametrize("share", [0.0, 2e-4, 0.01, 1.0])
def test_numba_equals_reference(shape, share):
    cells = grid(shape, share)
    assert torch.equal(under("numba", skip_distances, cells), skip_distances_reference(cells))


def test_reference_equals_loop():
    cells = grid((2, 20, 30, 40), 3e-4)
    distances = skip_distances_reference(cells)
    for slab in range(2):
        occupied = (cells[slab].nonzero() // 8).tolist()
        for block in itertools.product(*map(range, distances.shape[1:])):
            expected = min((max(abs(a - b) for a, b in zip(block, o)) for o in occupied), default=255)
            assert distances[slab][block] == expected


def test_grids_that_are_not_bool_are_refused():
    with pytest.raises(ValueError, match="occupancy must be bool"):
        skip_distances(torch.zeros(1, 8, 8, 8))
