"""numba versions of the kernels, for CPU tensors in float32 and float64."""
