"""CPU kernels of the renderer, compiled by Numba."""
