"""Triton versions of the kernels, for CUDA tensors; they also run on the CPU under TRITON_INTERPRET=1."""
