"""Kernels of a CPU, and those of a GPU on tensors of the CPU, in Triton's interpreter, or on a GPU where
there is one."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from unittest import mock

import pytest
import torch
from torch.library import _scoped_library

import ghgs_lit.method.model  # noqa: F401  (it has all operators)
from ghgs_lit.ops import dispatch

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
#: Kinds of kernels, and the device of the tensors that they compute with in tests.
WHERE = {"cpu": torch.device("cpu"), "cuda": DEVICE}

#: Operators with kernels of a GPU.
NAMES = {name for name, operator in dispatch.OPERATORS.items() if "cuda" in operator.kernels}


@contextmanager
def kernels(kind: str = "cuda") -> Iterator[list[str]]:
    """Inside, operators of the package are their kernels of ``kind`` for tensors on ``WHERE[kind]``; gives
    the names of those that are called."""
    called = []

    def noted(name):
        def call(*inputs):
            called.append(name)
            return dispatch.OPERATORS[name].kernels[kind](*inputs)

        return call

    with _scoped_library("ghgs_lit", "IMPL") as library, nullcontext() if kind == "cpu" else _triton():
        for name, operator in dispatch.OPERATORS.items():
            if kind in operator.kernels:
                library.impl(name, noted(name), WHERE[kind].type.upper(), allow_override=True)
        yield called


@contextmanager
def _triton() -> Iterator[None]:
    pytest.importorskip("triton")
    from ghgs_lit.ops import tiles  # here: it imports Triton

    rows = tiles.ROWS if DEVICE.type == "cuda" else 4096  # the interpreter is as fast for more
    with mock.patch.object(dispatch, "DEVICES", {DEVICE.type}), mock.patch.object(tiles, "ROWS", rows):
        yield
