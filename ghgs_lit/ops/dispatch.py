"""Operators of PyTorch with kernels: in Numba for a CPU, in Triton for a GPU.

An operator lies in a package of :mod:`ghgs_lit.ops`: its plain form in ``__init__``, its kernels in
``cpu`` and ``cuda``, which are imported at their first call. Callers see one function."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from importlib import import_module
from typing import Any

import torch
from torch import Tensor, nn
from torch.library import Library

LIBRARY = Library("ghgs_lit", "DEF")

#: Types of devices whose kernels are in Triton.
DEVICES = {"cuda"}

#: All operators by their names.
OPERATORS: dict[str, "Operator"] = {}


class Operator:
    """``torch.ops.ghgs_lit.<name>`` where a kernel can compute it, else its plain form.

    Being one operator, a kernel is one call in profiles. What needs a gradient that no kernel
    computes takes the plain form, which autograd differentiates.

    Args:
        schema: name, arguments and results in PyTorch's notation.
        plain: the same in plain PyTorch.
        package: its modules ``cpu`` and ``cuda`` have functions of this name that start kernels.
        fits: for each of these devices whether the kernel computes with some inputs.
        learned: for each device, places of the inputs whose gradients are computed by kernels, or 0.
        dtypes: floating-point types of the inputs.
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
        """The results; see the plain form."""
        return (self.packet.default if self.has_kernel(*inputs) else self.plain)(*inputs)

    def has_kernel(self, *inputs: Any) -> bool:
        """Whether a kernel computes with these."""
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
    """True: a kernel computes with all inputs."""
    return True


def without_gradients(*inputs: Any) -> bool:
    """Whether autograd is off."""
    return not torch.is_grad_enabled()


def _tensors(inputs: Sequence[Any]) -> Iterator[tuple[tuple[int, int], Tensor]]:
    """Tensors by the place of their input, and by their place in a list."""
    for n, value in enumerate(inputs):
        each = value if isinstance(value, list | tuple) else (value,)
        for k, tensor in enumerate(each):
            if isinstance(tensor, Tensor):
                yield (n, k), tensor


def _kind(tensor: Tensor) -> str:
    """The module with the kernels of a tensor's device; FakeTensors have none."""
    kind = tensor.device.type
    if kind in DEVICES:
        return "cuda" if kind != "cuda" or _triton_works() else ""
    return kind if type(tensor) in (Tensor, nn.Parameter) else ""


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
