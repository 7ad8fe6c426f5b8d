"""The Gaussian head for CPUs: all steps for a few Gaussians at a time."""

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.rotations import matrix_to_quaternion
from ghgs_lit.kernels import pool
from ghgs_lit.method.heads.activations import Constants
from ghgs_lit.types import Cameras, DepthMaps

#: Gaussians in one task.
_TASK = 1024


def is_supported(*tensors: Tensor | None) -> bool:
    """Whether the kernel can compute with these tensors: float32 on a CPU, without a gradient."""
    given = [x for x in tensors if x is not None]
    return not torch.is_grad_enabled() and pool.is_supported(*given) and pool.have_values(*given)


def activate(
    raw: tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None],
    image: Tensor,
    pixel: Tensor,
    maps: DepthMaps,
    points: Float[Tensor, "B V H W 3"],
    photo: Float[Tensor, "B V 3 H W"],
    share: Float[Tensor, "B V H W"] | None,
    cameras: Cameras,
    constants: Constants,
    on_surface: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """:func:`ghgs_lit.method.heads.activations.footprint_gaussians`, where :func:`is_supported`.

    Args:
        raw: offsets, scales, rotations, opacities and colours (or None) before activations.
        image: numbers of the images (``b * V + v``) that the Gaussians belong to, ascending.
        pixel: row-major indices of their pixels, ascending within an image.
        maps: depths in metres.
        points: world points of pixels, in metres.
        photo: colours of pixels, in [0, 1].
        share: factors of opacities; None: 1.
        cameras: of the images.
        constants: of ``FootprintAttributes``, with the limit of colours.
        on_surface: ``raw`` is in axes of the surface.

    Returns:
        Means, quaternions, scales, opacities and colours.
    """
    from ghgs_lit.method.heads.cpu.kernel import activate as compiled  # here: it loads a compiler

    *raw, color = raw
    color = raw[0].new_empty(0, 3) if color is None else color
    share = raw[0].new_empty(0, *photo.shape[3:]) if share is None else share.flatten(0, 1)
    turns = matrix_to_quaternion(cameras.extrinsics.flatten(0, 1)[:, :3, :3].mT)
    seen = (maps.depth, maps.valid, points, photo)
    tables = (*(x.flatten(0, 1) for x in seen), share)
    inputs = (*raw, color, pixel, *tables, cameras.intrinsics.flatten(0, 1), turns)
    count = len(pixel)
    out = [raw[0].new_empty(count, *size) for size in ((3,), (4,), (3,), (), (3,))]
    arrays = [x.detach().contiguous().numpy() for x in inputs]
    numbers = tuple(np.float32(x) for x in constants)
    ends = np.searchsorted(image.numpy(), np.arange(len(turns) + 1)).tolist()
    given = (*arrays, numbers, on_surface, *(x.numpy() for x in out))
    ranges = [(view, *pair) for view, pair in enumerate(pairwise(ends))]
    pool.run_rows(compiled(), given, ranges, _TASK, count)
    return tuple(out)
