"""Rendering for GPUs: the tiles of each splat, and what each place of a tile's list holds,
in two kernels."""
