"""The NeRF network: its size, its density at the start, and view dependence that is really absent when off."""

import pytest
import torch

from dnerf.fields import NeRFField


def count(field: NeRFField) -> int:
    return sum(p.numel() for p in field.parameters())


def test_without_view_dependence_there_is_no_directional_branch() -> None:
    assert count(NeRFField(2, 16, (), direction_frequencies=1)) == count(NeRFField(2, 16, (), direction_frequencies=9))
    assert count(NeRFField(2, 16, (), view_dependent=True, direction_frequencies=1)) < count(
        NeRFField(2, 16, (), view_dependent=True, direction_frequencies=9)
    )


def test_view_dependent_network_has_the_size_of_nerf() -> None:
    """NeRF's appendix A: eight layers of 256, the encoded position again at the fifth, a directional layer of 128."""
    encoded, viewed = 63, 27
    trunk = (encoded + 1) * 256 + 6 * 257 * 256 + (256 + encoded + 1) * 256
    head = 257 * 1 + 257 * 256 + (256 + viewed + 1) * 128 + 129 * 3
    assert count(NeRFField(view_dependent=True)) == trunk + head


def test_density_shift_thins_the_start() -> None:
    positions, times = torch.randn(500, 3), torch.zeros(500)
    thick, thin = (NeRFField(2, 16, (), density_shift=shift).density(positions, times).mean() for shift in (0, -5))
    assert thin < 0.05 < thick


def test_a_trunk_without_layers_is_refused() -> None:
    with pytest.raises(ValueError, match="num_layers must be > 0"):
        NeRFField(num_layers=0)
