"""Operators, each in plain PyTorch, with compiled kernels where these are faster."""
