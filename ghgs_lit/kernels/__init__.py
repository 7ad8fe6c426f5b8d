"""Shared parts of the CPU kernels: compilation with a disk cache, vectors, memory access,
threads."""
