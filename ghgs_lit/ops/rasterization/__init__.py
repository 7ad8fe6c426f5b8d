"""A Gaussian rasterizer for CPUs in explicitly vectorised kernels; ``layout`` describes their data."""
