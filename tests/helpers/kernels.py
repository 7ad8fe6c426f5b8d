"""Kernels of a GPU on tensors of the CPU, in Triton's interpreter,
or on a GPU where there is one."""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import pytest
import torch
from torch.library import _scoped_library

import ghgs_lit.method.model  # noqa: F401  (it has all operators)
from ghgs_lit.ops import dispatch

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


#: Operators with kernels of a GPU.
NAMES = {name for name, operator in dispatch.OPERATORS.items() if "cuda" in operator.kernels}


@contextmanager
def plain_pytorch() -> Iterator[None]:
    """Inside, operators of the package are their plain forms."""
    with mock.patch.object(dispatch.Operator, "has_kernel", return_value=False):
        yield


@contextmanager
def kernels() -> Iterator[list[str]]:
    """Inside, operators of the package are kernels; gives the names of those that are called."""
    pytest.importorskip("triton")
    from ghgs_lit.ops import tiles  # here: it imports Triton

    # the interpreter is as fast for more
    called, rows = [], tiles.ROWS if DEVICE.type == "cuda" else 4096

    def noted(name):
        def call(*inputs):
            called.append(name)
            return dispatch.OPERATORS[name].kernels["cuda"](*inputs)

        return call

    with (
        _scoped_library("ghgs_lit", "IMPL") as library,
        mock.patch.object(dispatch, "DEVICES", {DEVICE.type}),
        mock.patch.object(tiles, "ROWS", rows),
    ):
        for name in NAMES:
            library.impl(name, noted(name), DEVICE.type.upper(), allow_override=True)
        yield called
