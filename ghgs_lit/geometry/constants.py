"""Tensors that depend on sizes alone, made once for each device:
each takes a GPU at least one launch."""

from collections.abc import Callable
from functools import cache, lru_cache

import torch
from torch import Tensor


def constant(
    make: Callable[..., Tensor], *sizes: object, like: Tensor, dtype: torch.dtype | None = None
) -> Tensor:
    """``make(*sizes, dtype=, device=)``, computed once for the device of ``like``;
    never to be changed.

    Args:
        make: a function of PyTorch, such as ``torch.arange``, or one with the same two keywords.
        sizes: its hashable arguments.
        like: has the device, and the dtype unless one is given.
        dtype: of the result.

    Returns:
        The tensor that all callers share.
    """
    make_once = _made if like.device.type == "cpu" else _kept
    return make_once(make, sizes, dtype or like.dtype, like.device)


@lru_cache(maxsize=128)
@torch.inference_mode(False)  # they may be used with a gradient later
def _made(make: Callable[..., Tensor], sizes: tuple, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Make a constant on the CPU and copy it to its device without a wait.

    Args:
        make: as for :func:`constant`, as is the next.
        sizes: arguments of ``make``.
        dtype: of the result.
        device: of the result.

    Returns:
        The tensor.
    """
    # A list that is copied to a GPU by itself makes the host wait.
    return make(*sizes, dtype=dtype, device="cpu").to(device, non_blocking=True)


#: Without a limit: CUDA graphs read the memory of constants as long as they
#: are replayed.
_kept = cache(_made.__wrapped__)


def middles(count: int, **kind: object) -> Tensor:
    """The middles of equal parts of the way from 0 to 1.

    Args:
        count: number of parts S.
        kind: ``dtype`` and ``device``.

    Returns:
        Numbers [S], ascending.
    """
    return (torch.arange(count, **kind) + 0.5) / count


def other_images(elements: int, views: int, **kind: object) -> Tensor:
    """For each image ``b * V + v``, the images of the element's other views in cyclic order.

    Args:
        elements: batch size B.
        views: V, number of views of each element.
        kind: ``dtype`` and ``device``.

    Returns:
        Numbers of images [B V, V - 1].
    """
    view = torch.arange(views, **kind)
    others = (view[:, None] + view[1:]) % views
    return (views * torch.arange(elements, **kind)[:, None, None] + others).flatten(0, 1)
