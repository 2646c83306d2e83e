import pytest
import torch
from kernels.backends import serve_bfloat16

from dnerf import kernels


@pytest.fixture(params=["numba", "triton"])
def compiled(request):
    """Select a compiled backend, and give the device that its tensors must be on."""
    device = "cpu"
    if request.param == "triton":
        triton = pytest.importorskip("triton", reason="triton is not installed")
        if torch.cuda.is_available():
            device = "cuda"
        elif not triton.knobs.runtime.interpret:
            pytest.skip("no GPU, and triton was imported before it could be told to interpret")
    with kernels.use_backend(request.param):
        yield device


@pytest.fixture
def reference():
    with kernels.use_backend("reference"):
        yield


@pytest.fixture(params=["numba", "reference"])
def backend(request):
    """Select each of the two versions that every kernel has on a CPU, and give its name."""
    with kernels.use_backend(request.param):
        yield request.param


@pytest.fixture
def served(monkeypatch):
    """Kernels for vectors in bfloat16 serve networks on every CPU."""
    serve_bfloat16(monkeypatch)
