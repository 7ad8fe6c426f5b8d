"""PyTorch operators with kernels in Numba for CPUs and in Triton for GPUs.

Each operator is a package of :mod:`ghgs_lit.ops`: its plain PyTorch version is in ``__init__``, its
kernels are in ``cpu`` and ``cuda``, which are imported at the first call. Callers use one function."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from importlib import import_module
from typing import Any

import torch
from torch import Tensor
from torch.library import Library

from ghgs_lit.ops.pool import have_values

LIBRARY = Library("ghgs_lit", "DEF")

#: Device types whose kernels are written in Triton.
DEVICES = {"cuda"}

#: All operators by name.
OPERATORS: dict[str, "Operator"] = {}


class Operator:
    """Call ``torch.ops.ghgs_lit.<name>`` where a kernel supports the inputs, else the plain version.

    A kernel appears as one operator in profiles. Inputs that need a gradient which no kernel computes
    go to the plain version, which autograd differentiates.

    Args:
        schema: name, arguments and results in PyTorch's schema notation.
        plain: the operator in plain PyTorch.
        package: package whose modules ``cpu`` and ``cuda`` define a function of the operator's name,
            which launches the kernel.
        fits: for each device type, a function of the inputs: whether the kernel supports them.
        learned: for each device type, the positions of inputs whose gradient the kernels compute or
            is 0.
        dtypes: supported floating-point dtypes of the inputs.
    """

    def __init__(
        self,
        schema: str,
        plain: Callable[..., Any],
        package: str,
        fits: Mapping[str, Callable[..., bool]],
        learned: Mapping[str, Sequence[int]] | None = None,
        dtypes: Sequence[torch.dtype] = (torch.float32,),
    ):
        self.name = schema.partition("(")[0]
        self.plain = plain
        self.kernels = {device: partial(self._launch, f"{package}.{device}") for device in fits}
        self.fits = fits
        self.learned = learned or {}
        self.dtypes = dtypes
        LIBRARY.define(schema)
        LIBRARY.impl(self.name, plain, "CompositeExplicitAutograd")
        for device, kernel in self.kernels.items():
            LIBRARY.impl(self.name, kernel, device.upper())
        self.packet = getattr(torch.ops.ghgs_lit, self.name)
        OPERATORS[self.name] = self

    def __call__(self, *inputs: Any) -> Any:
        """Compute the results; see the plain version."""
        return (self.packet.default if self.has_kernel(*inputs) else self.plain)(*inputs)

    def has_kernel(self, *inputs: Any) -> bool:
        """Whether a kernel supports these inputs."""
        given = dict(_tensors(inputs))
        kinds = {_kind(tensor) for tensor in given.values()}
        kind = kinds.pop()
        if kinds or kind not in self.kernels:
            return False
        if any(x.is_floating_point() and x.dtype not in self.dtypes for x in given.values()):
            return False
        learned = self.learned.get(kind, ())
        wanted = (place for (place, _), x in given.items() if x.requires_grad)
        if torch.is_grad_enabled() and any(place not in learned for place in wanted):
            return False
        return self.fits[kind](*inputs)

    def _launch(self, module: str, *inputs: Any) -> Any:
        kernel = getattr(import_module(module), self.name)
        with torch.cuda.device_of(inputs[0]):
            return kernel(*inputs)


def everything(*inputs: Any) -> bool:
    """Always true: the kernel supports all inputs."""
    return True


def without_gradients(*inputs: Any) -> bool:
    """Whether autograd is disabled."""
    return not torch.is_grad_enabled()


def _tensors(inputs: Sequence[Any]) -> Iterator[tuple[tuple[int, int], Tensor]]:
    """Pairs of ((position of the input, position in its list), tensor)."""
    for n, value in enumerate(inputs):
        each = value if isinstance(value, list | tuple) else (value,)
        for k, tensor in enumerate(each):
            if isinstance(tensor, Tensor):
                yield (n, k), tensor


def _kind(tensor: Tensor) -> str:
    """Name of the module with the kernels for a tensor's device; empty for FakeTensors."""
    kind = tensor.device.type
    if kind in DEVICES:
        return "cuda" if kind != "cuda" or _triton_works() else ""
    return kind if have_values(tensor) else ""


@cache
def _triton_works() -> bool:
    """Whether Triton can launch kernels: its first launch needs a C compiler."""
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
