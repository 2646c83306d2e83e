"""What all tests share: reproducible hypothesis runs without a deadline (compiled kernels are slow the first time)."""

import os

# Tests in parallel share the cores; this is read when torch is imported, and by the scripts that tests start.
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    os.environ["OMP_NUM_THREADS"] = str(max(1, cores // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])))

import pytest
import torch
from hypothesis import settings

# Triton reads this when it is imported, by whichever test comes first: without a GPU its kernels run in the
# interpreter, on CPU tensors.
if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"

settings.register_profile("dnerf", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("dnerf")


@pytest.fixture(autouse=True)
def fixed_seed() -> None:
    """Parameters and data drawn without a generator are the same in every run and in any order of tests."""
    torch.manual_seed(0)
