"""What the kernels of a CPU share: compilation and its cache, vectors, memory, threads."""
