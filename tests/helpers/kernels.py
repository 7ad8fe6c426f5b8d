"""Kernels of a GPU on tensors of the CPU, in Triton's interpreter,
or on a GPU where there is one."""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import pytest
import torch
from torch.library import _scoped_library

from ghgs_lit.kernels import gpu

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@contextmanager
def kernels() -> Iterator[list[str]]:
    """Inside, operators of the package are kernels; gives the names of those that are called."""
    pytest.importorskip("triton")
    from ghgs_lit.kernels import tiles  # here: it imports Triton

    # the interpreter is as fast for more
    called, rows = [], tiles.ROWS if DEVICE.type == "cuda" else 4096

    def noted(name):
        def call(*inputs):
            called.append(name)
            return gpu.KERNELS[name](*inputs)

        return call

    with (
        _scoped_library("ghgs_lit", "IMPL") as library,
        mock.patch.object(gpu, "DEVICES", {DEVICE.type}),
        mock.patch.object(tiles, "ROWS", rows),
    ):
        for name in gpu.KERNELS:
            library.impl(name, noted(name), DEVICE.type.upper(), allow_override=True)
        yield called
