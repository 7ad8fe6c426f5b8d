"""Evaluation of dense heads in windows around the subject."""

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.method.heads.dpt import DPTHead
from ghgs_lit.method.heads.guide import Guide
from ghgs_lit.method.plan.window import Span, Window
from ghgs_lit.ops.pool import at_once, even_parts
from ghgs_lit.types import Tokens

#: Values of the largest map held in memory without a gradient (32 MB in float32); on a GPU 4 GB.
_LARGEST = 1 << 23
_GPU_LARGEST = 1 << 30


@dataclass(frozen=True)
class Part:
    """Maps of consecutive images in a common window."""

    images: slice
    window: Window
    maps: Float[Tensor, "n o h w"]


def decode(
    dpt: DPTHead,
    tokens: Tokens,
    guide: Guide | None,
    windows: Sequence[Window | None] | None,
    together: int = 1,
) -> Iterator[Part]:
    """Decode raw maps of images in their windows, yielding consecutive images in order.

    Images with small maps share a window. Without a gradient, larger maps are computed one after
    another, each in its own window, to save memory and work.

    Args:
        dpt: the head.
        tokens: tokens of all images.
        guide: maps of whole images, if the head has a guide.
        windows: one per image; None: whole images. Images without a window are left out; if all are,
            one pixel is decoded, so that gradients of 0 flow.
        together: least number of consecutive images that are decoded at once.
    """
    b, v, rows, columns = tokens.grid
    size = (tokens.patch_size * rows, tokens.patch_size * columns)
    if windows is None:
        windows = [Window.whole(size)] * (b * v)
    elif not any(windows):
        windows = [Window(*(Span(0, 1, full) for full in size)), *windows[1:]]
    largest = at_once(tokens.semantic.device, _LARGEST, _GPU_LARGEST)
    most = b * v if torch.is_grad_enabled() else largest // (dpt.full_channels * math.prod(size))
    for images in _runs(windows, most, together):
        window = functools.reduce(Window.hull, windows[images])
        seen = None if guide is None else tuple(part[images] for part in guide)
        yield Part(images, window, dpt(tokens.of_images(images), seen, window))


def _runs(windows: Sequence[Window | None], most: int, together: int) -> Iterator[slice]:
    """Slices of about equal size of consecutive images with a window: at most ``most`` images, in groups
    of ``together`` that are not split."""
    start = 0
    for has_window, group in itertools.groupby(windows, bool):
        count = len(list(group))
        for part in even_parts(count // together, most // together) if has_window else ():
            yield slice(start + together * part.start, start + together * part.stop)
        start += count
