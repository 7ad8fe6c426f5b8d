"""Chains of small operators as one kernel of a GPU. Kernels are written in Triton, which comes
with PyTorch for CUDA; they lie in folders ``cuda`` of the rooms and are imported at their first
call on a GPU."""

import warnings
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

import torch
from torch import Tensor
from torch.library import Library

_library = Library("ghgs_lit", "DEF")

#: Types of devices that run the operators of this package.
DEVICES = {"cuda"}

#: Each operator by its name: its kernel, and the same in plain PyTorch.
KERNELS: dict[str, Callable[..., Any]] = {}
PLAIN: dict[str, Callable[..., Any]] = {}


def is_supported(*tensors: Tensor | None) -> bool:
    """Whether kernels compute with these: float32 and whole numbers,
    on a GPU on which Triton works.

    Args:
        tensors: inputs of an operator, at least one; None: an input that is left out.
    """
    given = [x for x in tensors if x is not None]
    if any(x.device.type not in DEVICES for x in given):
        return False
    if any(x.is_floating_point() and x.dtype != torch.float32 for x in given):
        return False
    return given[0].device.type != "cuda" or _triton_works()


@cache
def _triton_works() -> bool:
    """Whether Triton can start kernels. It needs a C compiler once, which not every machine has."""
    try:
        from triton.runtime import driver  # here: it comes with PyTorch for CUDA only

        driver.active.get_current_target()
    except ImportError:
        return False
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        warnings.warn(
            f"Triton: expected to start kernels; found {reason}; plain PyTorch is used", stacklevel=2
        )
        return False
    return torch.cuda.get_device_capability() >= (7, 5)


def operator(schema: str, plain: Callable[..., Any], room: str) -> Callable[..., Any]:
    """An operator of PyTorch that is a kernel on CUDA, and plain PyTorch on any other device.

    Being one operator, it is one call in profiles.

    Args:
        schema: name, arguments and results in PyTorch's notation.
        plain: the same in plain PyTorch.
        room: the package whose module ``kernel`` has a function of this name,
            which launches the kernel.

    Returns:
        The operator, without a gradient.
    """
    name = schema.partition("(")[0]

    def launch(*inputs):
        with torch.cuda.device_of(inputs[0]):
            return getattr(import_module(f"{room}.kernel"), name)(*inputs)

    _library.define(schema)
    _library.impl(name, plain, "CompositeExplicitAutograd")
    _library.impl(name, launch, "CUDA")
    KERNELS[name] = launch
    PLAIN[name] = plain
    return getattr(torch.ops.ghgs_lit, name).default
