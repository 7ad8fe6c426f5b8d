"""CPU kernels, and GPU kernels in Triton's interpreter on CPU tensors, or on a GPU if there is one."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from unittest import mock

import pytest
import torch
from torch.library import _scoped_library

import ghgs_lit.method.model  # noqa: F401  (imports all operators)
from ghgs_lit.ops import dispatch

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
#: Kinds of kernels, with the device of their tensors in tests.
WHERE = {"cpu": torch.device("cpu"), "cuda": DEVICE}

#: Operators with GPU kernels.
NAMES = {name for name, operator in dispatch.OPERATORS.items() if "cuda" in operator.kernels}


@contextmanager
def kernels(kind: str = "cuda") -> Iterator[list[str]]:
    """Within the context, run kernels of ``kind`` for tensors on ``WHERE[kind]``; yields the names of
    called operators."""
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
    from ghgs_lit.ops import tiles  # imports Triton

    rows = tiles.ROWS if DEVICE.type == "cuda" else 4096  # the interpreter's time hardly grows with rows
    with mock.patch.object(dispatch, "DEVICES", {DEVICE.type}), mock.patch.object(tiles, "ROWS", rows):
        yield
