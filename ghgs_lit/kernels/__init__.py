"""Shared parts of the CPU kernels: compilation with a cache on disk, vectors, memory access, threads."""
