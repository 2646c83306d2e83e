import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from kernels.backends import under

from dnerf import kernels
from dnerf.kernels import backend


def test_misspelt_environment_variable_is_named_on_first_use():
    code = "import torch\nfrom dnerf import kernels\nkernels.packed_weights(torch.ones(1), torch.tensor([0, 1]))"
    result = subprocess.run(
        [sys.executable, "-c", code], env={"DNERF_KERNELS": "nunba"}, capture_output=True, text=True, check=False
    )
    assert re.search("ValueError: kernel backend must be one of .*'nunba'", result.stderr)


def test_context_manager_restores_the_backend_after_an_error():
    before, during = kernels.get_backend(), []

    def fail():
        during.append(kernels.get_backend())
        raise RuntimeError

    with pytest.raises(RuntimeError):
        under("reference", fail)
    assert [*during, kernels.get_backend()] == ["reference", before]


@pytest.mark.parametrize(("tensor", "expected"), [
    (torch.zeros(1), "numba"), (torch.zeros(1, dtype=torch.float64), "numba"),
    (torch.zeros(1, dtype=torch.bfloat16), "reference"), (torch.zeros(1, device="meta"), "reference"),
])  # fmt: skip
def test_auto_chooses_by_device_and_dtype(tensor, expected):
    assert under("auto", backend.choose, tensor) == expected


def test_numba_refuses_other_devices():
    with kernels.use_backend("numba"), pytest.raises(ValueError, match="on the CPU, got meta"):
        backend.choose(torch.zeros(1, device="meta"))


def test_triton_refuses_cpu_tensors_unless_interpreted(monkeypatch):
    pytest.importorskip("triton", reason="triton is not installed")
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with kernels.use_backend("triton"), pytest.raises(ValueError, match="needs CUDA tensors"):
        backend.choose(torch.zeros(1))


@pytest.mark.parametrize(("name", "message"), [("cuda", "got 'cuda'"), ("triton", "not installed")])
def test_backends_that_do_not_exist_are_named(monkeypatch, name, message):
    monkeypatch.setattr(backend, "has_triton", lambda: False)
    with pytest.raises(ValueError, match=message):
        kernels.set_backend(name)


def test_kernels_may_run_in_several_python_threads():
    depths, offsets = torch.rand(3000) * 0.1, torch.arange(0, 3001, 30)
    with kernels.use_backend("numba"):
        expected = kernels.packed_weights(depths, offsets)
        with ThreadPoolExecutor(4) as pool:
            results = list(pool.map(lambda _: kernels.packed_weights(depths, offsets), range(40)))
    assert all(torch.equal(r, expected) for r in results)
