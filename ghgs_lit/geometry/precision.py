"""Precision: half precision for matrix products of networks, float32 for geometry and last layers."""

import warnings
from collections.abc import Hashable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import nn

from ghgs_lit.errors import require, require_choice

PRECISIONS = ("inherit", "float32", "tf32", "bfloat16", "float16", "auto")


def has_bfloat16(device: torch.device) -> bool:
    """Whether the device has bfloat16 instructions; without them bfloat16 is slower than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities() if device.type == "cpu" else {}
    return any(value is True for name, value in capabilities.items() if "bf16" in name)


def fast_precision(stored: torch.dtype, device: torch.device) -> torch.dtype:
    """Dtype to load weights in: float32 instead of a half precision that the processor lacks.

    On a CPU, float16 takes four times as long as float32 and loses digits.

    Args:
        stored: dtype of the stored weights.
        device: where they are used.
    """
    if device.type == "cpu" and (
        stored == torch.float16 or (stored == torch.bfloat16 and not has_bfloat16(device))
    ):
        return torch.float32
    return stored


def precision_of(name: str, device: torch.device) -> AbstractContextManager:
    """Context manager for a forward pass in the precision ``name``.

    Args:
        name: one of :data:`PRECISIONS`. ``inherit``: the caller's, but with PyTorch's default on CUDA
            (TF32 in convolutions alone) products use TF32, too, with one warning; ``float32``:
            :func:`exact`; ``tf32``: TF32 in all products and convolutions; ``auto``: bfloat16 if
            the device has it, else float16 on CUDA and float32 on a CPU.
        device: device of the pass.

    Raises:
        InputError: for an unknown precision, TF32 or float16 on a CPU, or bfloat16 on a device
            without it.
    """
    require_choice("precision", name, PRECISIONS)
    if name == "inherit":
        return _inherit() if device.type == "cuda" else nullcontext()
    if name == "bfloat16":
        require(has_bfloat16(device), "precision", "float32 on a device without bfloat16", name)
    if name in ("tf32", "float16"):
        require(device.type == "cuda", "precision", f"{name} on CUDA only", device.type)
    half = half_precision(name, device)
    if half is None:
        return _float32(device.type, rounding=name == "tf32")
    return torch.autocast(device.type, half)


def bfloat16_where_possible(device: torch.device) -> AbstractContextManager:
    """Autocast to bfloat16 where the device has it; elsewhere the caller's precision."""
    return torch.autocast(device.type, torch.bfloat16) if has_bfloat16(device) else nullcontext()


def half_precision(name: str, device: torch.device) -> torch.dtype | None:
    """Half precision of products for a precision of :data:`PRECISIONS`; None: float32.

    ``device`` matters for ``auto`` alone.
    """
    if name == "auto":
        slow = "float16" if device.type == "cuda" else "float32"
        name = "bfloat16" if has_bfloat16(device) else slow
    return getattr(torch, name) if name in ("bfloat16", "float16") else None


def exact(device: str) -> AbstractContextManager[None]:
    """Full float32: no autocast, and no rounding of factors in products and convolutions.

    Factors are otherwise rounded to TF32 or bfloat16 if ``torch.set_float32_matmul_precision``
    allows it, and by default in convolutions on CUDA (TF32 has 11 bits: 1 mm at 2 m).

    Args:
        device: type of the device, ``cpu`` or ``cuda``.
    """
    return _float32(device, rounding=False)


@contextmanager
def _inherit() -> Iterator[None]:
    """The caller's precision on CUDA, with TF32 products if PyTorch's default is active.

    That default uses TF32 in convolutions but not in products: slower, and no more accurate overall."""
    before = _Rounding.now("cuda")
    if not before.is_default:
        yield
        return
    _warn_rounding()
    round_products(True, "cuda")
    try:
        yield
    finally:
        before.restore("cuda")


@cache
def _warn_rounding() -> None:
    warnings.warn(
        "precision=inherit: factors of products are rounded to TF32 (11 bits), as PyTorch does in "
        "convolutions on a GPU; precision=float32 rounds neither",
        stacklevel=6,
    )


@contextmanager
def _float32(device: str, rounding: bool) -> Iterator[None]:
    """Disable autocast and, with ``rounding``, use TF32, else full float32."""
    before = _Rounding.now(device)
    changes = rounding or before.is_any
    if changes:
        round_products(rounding, device, before.of_older is not None)
    try:
        with torch.autocast(device, enabled=False):
            yield
    finally:
        if changes:
            before.restore(device)


def round_products(rounding: bool, device: str = "cuda", also_older: bool = True) -> None:
    """Set whether float32 products and convolutions round their factors to TF32.

    Args:
        rounding: True: TF32; False: full float32.
        device: type of the device, ``cpu`` or ``cuda``.
        also_older: also set the switches that PyTorch had before 2.9.
    """
    if also_older:
        torch.set_float32_matmul_precision("high" if rounding else "highest")
        torch.backends.cudnn.allow_tf32 = rounding
    for module in _modules(device):
        module.fp32_precision = "tf32" if rounding else "ieee"


def rounds_products(device: str) -> bool:
    """Whether float32 products or convolutions currently round their factors on a type of device."""
    return _Rounding.now(device).is_any


def rounding_state(device: str) -> Hashable:
    """State of all of PyTorch's switches for rounding on a type of device, as a key of caches."""
    now = _Rounding.now(device)
    return tuple(now.of_modules), now.of_older


@dataclass(frozen=True)
class _Rounding:
    """State of PyTorch's switches for rounding.

    Attributes:
        of_modules: ``fp32_precision`` of :func:`_modules`.
        of_older: switches before PyTorch 2.9, for products and for convolutions on CUDA; None where
            PyTorch raises on reading them, because the newer ones hold a state that they cannot
            express.
    """

    of_modules: list[str]
    of_older: tuple[str, bool] | None

    @classmethod
    def now(cls, device: str) -> "_Rounding":
        try:
            older = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
        except RuntimeError:
            older = None
        return cls([module.fp32_precision for module in _modules(device)], older)

    @property
    def is_any(self) -> bool:
        """Whether some products or convolutions round."""
        if not self.of_modules:
            return self.of_older != ("highest", False)
        products = self.of_older is not None and self.of_older[0] != "highest"
        return products or not {"ieee", "none"}.issuperset(self.of_modules)

    @property
    def is_default(self) -> bool:
        """Whether convolutions on CUDA round and products do not: PyTorch's default."""
        if self.of_older != ("highest", True):
            return False
        return not self.of_modules or (
            self.of_modules[2] == "tf32" and self.of_modules[0] in ("ieee", "none")
        )

    def restore(self, device: str) -> None:
        if self.of_older is not None:
            torch.set_float32_matmul_precision(self.of_older[0])
            torch.backends.cudnn.allow_tf32 = self.of_older[1]
        for module, value in zip(_modules(device), self.of_modules, strict=True):
            module.fp32_precision = value


@cache
def _modules(device: str) -> list[Any]:
    """Backends whose ``fp32_precision`` controls rounding on a type of device, in PyTorch 2.9 and
    later; products first."""
    matmul = torch.backends.cuda.matmul
    cudnn = torch.backends.cudnn
    mkldnn = torch.backends.mkldnn
    if not hasattr(matmul, "fp32_precision"):
        return []
    if device == "cpu":
        return [matmul, mkldnn.matmul, mkldnn.conv]
    # Recurrent layers have one older switch with convolutions.
    return [matmul, mkldnn.matmul, cudnn.conv, cudnn.rnn]


def keep_rounded(module: nn.Module, dtype: torch.dtype) -> None:
    """Store weights of linear layers and convolutions in the half precision of autocast.

    Autocast casts them at every call: this gives the same values in half the memory, without a
    kernel per weight. Afterwards the module runs under autocast to ``dtype`` only.

    Args:
        module: changed in place.
        dtype: bfloat16 or float16.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
            layer.to(dtype)


def without_float16(device: str) -> AbstractContextManager:
    """Disable float16 autocast on a type of device: activations and gradients of dense heads
    overflow in it."""
    low = torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device) == torch.float16
    return torch.autocast(device, enabled=False) if low else nullcontext()
