"""Operators: each in plain PyTorch, with compiled kernels beside it where these win."""
