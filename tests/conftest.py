"""What all tests share: reproducible hypothesis runs without a deadline (compiled kernels are slow the first time)."""

import pytest
import torch
from hypothesis import settings

settings.register_profile("dnerf", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("dnerf")


@pytest.fixture(autouse=True)
def fixed_seed() -> None:
    """Parameters and data drawn without a generator are the same in every run and in any order of tests."""
    torch.manual_seed(0)
