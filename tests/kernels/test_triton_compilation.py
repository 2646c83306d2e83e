"""The interpreter accepts more than Triton's compiler: this compiles every kernel for a GPU, without having one."""

import os
import subprocess
import sys

import pytest


def compile_kernels():
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from dnerf.kernels.gpu import grid_encode, march, packed

    grid = {"num_features": 8, "width": 8, "block": 128}
    marching = {"num_slabs": 16, "nx": 128, "ny": 128, "nz": 64, "block": 64}
    kernels = [
        (grid_encode._forward, grid), (grid_encode._grad_table, grid), (grid_encode._grad_positions, grid),
        (packed._weights, {"terms": 9, "block": 128}), (packed._grad_optical_depth, {"block": 128}),
        (packed._sums, {"weighted": True, "block": 32, "width": 4}),
        (march._march, marching | {"fill": False}), (march._march, marching | {"fill": True}),
    ]  # fmt: skip
    kinds = {"occupancy": "*u8", "limit": "i64"} | dict.fromkeys(("num_samples", "num_levels", "num_columns"), "i32")
    kinds |= dict.fromkeys(("levels", "offsets", "ray_indices"), "*i64")
    for real in ("*fp32", "*fp64"):
        for kernel, constants in kernels:
            signature = {n: "constexpr" if n in constants else kinds.get(n, real) for n in kernel.arg_names}
            options = {"enable_fp_fusion": kernel is not march._march}
            source = ASTSource(kernel, signature, constants)
            ptx = triton.compile(source, target=GPUTarget("cuda", 80, 32), options=options).asm["ptx"]
            assert kernel is not march._march or "fma.rn" not in ptx


@pytest.mark.slow
def test_every_kernel_compiles_for_cuda():
    pytest.importorskip("triton", reason="triton is not installed")
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    command = [sys.executable, __file__]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


if __name__ == "__main__":
    compile_kernels()
