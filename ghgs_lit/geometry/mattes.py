"""Soft mattes: pixels at a silhouette show the subject in a part of their area.

Photographs on black are premultiplied by that part, as renders of Gaussians are (Porter and Duff, SIGGRAPH
1984). A Gaussian needs the colour of the surface itself.
"""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.types import Batch


def with_matte(batch: Batch, least: float | None) -> Batch:
    """The batch whose masks hold all pixels that show more of the subject than ``least``. ``batch``: as it is
    where it has no matte. ``least``: a share; None: the batch without its matte."""
    if batch.alpha is None:
        return batch
    if least is None:
        return dataclasses.replace(batch, alpha=None)
    return dataclasses.replace(batch, masks=batch.alpha > least)


def coverage(batch: Batch) -> Float[Tensor, "B V H W"]:
    """The share of each pixel that shows the subject: 0 or 1 by the mask where there is no matte."""
    shares = batch.masks if batch.alpha is None else batch.alpha
    return shares.to(at_least_float32(batch.images).dtype)


def surface_colors(batch: Batch) -> Float[Tensor, "B V 3 H W"]:
    """Photographs divided by the matte, at most 1: the colour of what a pixel shows of the subject."""
    images = at_least_float32(batch.images)
    return images if batch.alpha is None else unmultiplied(images, batch.alpha.to(images.dtype)[:, :, None])


def unmultiplied(images: Tensor, alpha: Tensor) -> Tensor:
    """Colours divided by ``alpha``, at most 1; as they are where it is 0 and says nothing of them."""
    return torch.where(alpha > 0, (images / torch.where(alpha > 0, alpha, 1)).clamp(max=1), images)


def on_black(batch: Batch) -> Float[Tensor, "B V 3 H W"]:
    """Photographs without what is beside the subject; with a matte they are on black already."""
    return batch.images if batch.alpha is not None else batch.images * coverage(batch)[:, :, None]
