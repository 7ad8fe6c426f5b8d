"""A rasterizer for CPUs, in kernels with explicit vectors; ``layout`` describes their data."""
