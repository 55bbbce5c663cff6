"""The same pass for a CPU (Numba) and a GPU (Triton), beside plain PyTorch."""
