"""Photographs on cores: kernels that Numba compiles."""
