"""Precision: half precision for products of networks, float32 for geometry and last projections."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch

from ghgs_lit.errors import choice, require

PRECISIONS = ("inherit", "float32", "bfloat16", "float16", "auto")


def has_bfloat16(device: torch.device) -> bool:
    """Whether the device has bfloat16 instructions; without them bfloat16 is slower than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities() if device.type == "cpu" else {}
    return any(found is True for name, found in capabilities.items() if "bf16" in name)


def fast_precision(stored: torch.dtype, device: torch.device) -> torch.dtype:
    """Dtype to use for weights that are ``stored`` in one: float32 instead of a half precision that the
    processor lacks. On a CPU float16 takes four times as long as float32, and loses digits."""
    if device.type == "cpu" and (
        stored == torch.float16 or (stored == torch.bfloat16 and not has_bfloat16(device))
    ):
        return torch.float32
    return stored


def precision_of(name: str, device: torch.device) -> AbstractContextManager:
    """The autocast context of a forward pass. ``name``: one of :data:`PRECISIONS`; ``inherit``: the caller's;
    ``auto``: bfloat16 if the device has it, else float16 on CUDA and float32 on a CPU. InputError: float16 on
    a CPU, or bfloat16 on a device without it."""
    choice("precision", name, PRECISIONS)
    if name == "inherit":
        return nullcontext()
    if name == "auto":
        slow = "float16" if device.type == "cuda" else "float32"
        name = "bfloat16" if has_bfloat16(device) else slow
    if name == "bfloat16":
        require(has_bfloat16(device), "precision", "float32 on a device without bfloat16", name)
    require(name != "float16" or device.type == "cuda", "precision", "float16 on CUDA only", device.type)
    if name == "float32":
        return torch.autocast(device.type, enabled=False)
    return torch.autocast(device.type, getattr(torch, name))


@contextmanager
def exact(device: str) -> Iterator[None]:
    """Full float32: no autocast, and no products with factors rounded to TF32 or bfloat16, as
    ``torch.set_float32_matmul_precision`` allows (TF32 has 11 bits: 1 mm at 2 m). ``device``: its type."""
    backends = [b.matmul for b in (torch.backends.cuda, torch.backends.mkldnn) if hasattr(b, "matmul")]
    before = {b: getattr(b, "fp32_precision", "ieee") for b in backends}  # PyTorch 2.9 and later
    rounding = [b for b, value in before.items() if value not in ("ieee", "none")]
    for backend in rounding:
        backend.fp32_precision = "ieee"
    try:
        with torch.autocast(device, enabled=False):
            yield
    finally:
        for backend in rounding:
            backend.fp32_precision = before[backend]


def without_float16(device: str) -> AbstractContextManager:
    """Turn off float16 autocast on a type of device: maps and gradients of dense heads overflow in it."""
    low = torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device) == torch.float16
    return torch.autocast(device, enabled=False) if low else nullcontext()
