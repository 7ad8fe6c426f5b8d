"""Tensors that depend on sizes alone, computed once per device: each costs a GPU at least one
launch."""

from collections.abc import Callable
from functools import cache, lru_cache

import torch
from torch import Tensor


def constant(
    make: Callable[..., Tensor], *sizes: object, like: Tensor, dtype: torch.dtype | None = None
) -> Tensor:
    """Return the cached ``make(*sizes, dtype=, device=)``.

    All callers share the tensor: never change it in place.

    Args:
        make: a function of PyTorch, such as ``torch.arange``, or any with these two keywords.
        sizes: its positional arguments, hashable.
        like: gives the device, and the dtype if ``dtype`` is None.
        dtype: of the result.
    """
    make_once = _make if like.device.type == "cpu" else _kept
    return make_once(make, sizes, dtype or like.dtype, like.device)


@lru_cache(maxsize=128)
@torch.inference_mode(False)  # a later use may need gradients
def _make(make: Callable[..., Tensor], sizes: tuple, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Compute a constant on the CPU and copy it to its device."""
    # A tensor made from a list directly on a GPU synchronises device and host.
    return make(*sizes, dtype=dtype, device="cpu").to(device, non_blocking=True)


#: Without a limit: captured CUDA graphs read the memory of constants at every replay.
_kept = cache(_make.__wrapped__)


def middles(count: int, **kind: object) -> Tensor:
    """Midpoints [count], ascending, of ``count`` equal parts of [0, 1].

    Args:
        count: number of parts.
        kind: ``dtype`` and ``device``.
    """
    return (torch.arange(count, **kind) + 0.5) / count


def other_images(elements: int, views: int, **kind: object) -> Tensor:
    """Indices of the other views of each image's element, in cyclic order.

    Args:
        elements: batch size B.
        views: number of views V of each element.
        kind: ``dtype`` and ``device``.

    Returns:
        Indices of images [B V, V - 1]; image ``b * V + v`` is view v of element b.
    """
    view = torch.arange(views, **kind)
    others = (view[:, None] + view[1:]) % views
    return (views * torch.arange(elements, **kind)[:, None, None] + others).flatten(0, 1)
