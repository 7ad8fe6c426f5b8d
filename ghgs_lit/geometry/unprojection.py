"""Unprojection of depth maps to world points of pixels and of tokens (paper, section 3.2)."""

from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.config.options import Options
from ghgs_lit.geometry.projection import at_least_float32, pixel_centers, unproject_maps
from ghgs_lit.types import Batch, DepthMaps, Points, Tokens

#: Padding in pixels that the token grid of the release ignores (512 + 2 x 3 = 518).
RELEASE_BORDER = 3


class Unprojection(Options):
    """Stage ``unprojection(depth_maps, tokens, batch) -> Points``, without parameters, in float32 or
    wider.

    With ``tokens="subject"``, mean pixel and mean depth of the subject keep a token's point on the
    surface: at a silhouette, the centre of a patch may lie off the subject. A patch without a valid
    pixel uses its centre and mean depth, and is invalid. With ``"release"``, inverse depths are
    sampled bilinearly (2 x 2), and pixels are the centres of a grid over the image without its
    padding; the same tokens are valid."""

    group = "unprojection"
    tokens: Literal["subject", "release"] = "subject"
    """Position of a token: subject: mean pixel and mean depth of the subject's pixels in its patch;
    release: as in the authors' code, which scales intrinsics by 37 / 512 and ignores the padding."""

    def __call__(self, depth_maps: DepthMaps, tokens: Tokens, batch: Batch) -> Points:
        locate = subject_tokens if self.tokens == "subject" else _release_tokens
        pixels, depth, valid = locate(depth_maps, tokens.patch_size)
        cameras = batch.cameras
        points = unproject_maps(depth, cameras, pixels)
        # The maps cover every patch, also those without a token.
        index = (tokens.image, tokens.row, tokens.column)
        tokens_valid = valid.flatten(0, 1)[index]
        return Points(
            pixels=unproject_maps(depth_maps.depth, cameras),
            valid=depth_maps.valid,
            tokens=points.flatten(0, 1)[index],
            tokens_valid=tokens_valid if tokens.real is None else tokens_valid & tokens.real,
            token_image=tokens.image,
        )


def _release_tokens(depth_maps: DepthMaps, patch_size: int) -> tuple[Tensor, Tensor, Tensor]:
    height, width = depth_maps.depth.shape[-2:]
    grid = (height // patch_size, width // patch_size)
    inverse = F.interpolate(1 / depth_maps.depth, size=grid, mode="bilinear", align_corners=False)
    inner = inverse.new_tensor([width - 2 * RELEASE_BORDER, height - 2 * RELEASE_BORDER])
    centers = pixel_centers(*grid, inverse) * (inner / inner.new_tensor(grid[::-1])) + RELEASE_BORDER
    valid = F.max_pool2d(depth_maps.valid.float(), patch_size).bool()
    return centers.expand(*inverse.shape, 2), 1 / inverse, valid


def subject_tokens(
    depth_maps: DepthMaps, patch_size: int
) -> tuple[Float[Tensor, "B V h w 2"], Float[Tensor, "B V h w"], Bool[Tensor, "B V h w"]]:
    """Mean pixel and mean depth of the valid pixels of each patch; of all its pixels if none is valid.

    Args:
        depth_maps: with sides that are multiples of the patch size.
        patch_size: side of a patch in pixels.

    Returns:
        Mean pixels ``(u, v)`` [B, V, h, w, 2], mean depths [B, V, h, w], and whether a patch has
        valid pixels [B, V, h, w].
    """
    depth = at_least_float32(depth_maps.depth)
    valid = depth_maps.valid
    centers = pixel_centers(*depth.shape[-2:], depth).permute(2, 0, 1)
    values = torch.cat(
        (depth[..., None, :, :], centers.expand(*depth.shape[:2], 2, *depth.shape[-2:])), dim=2
    )
    count = F.avg_pool2d(valid.to(depth.dtype), patch_size)
    any_valid = count > 0
    weights = (
        valid[:, :, None]
        | ~any_valid.repeat_interleave(patch_size, -2).repeat_interleave(patch_size, -1)[:, :, None]
    )
    sums = F.avg_pool2d(torch.where(weights, values, 0).flatten(0, 1), patch_size).unflatten(
        0, depth.shape[:2]
    )
    means = sums / torch.where(any_valid, count, 1)[:, :, None]
    return means[:, :, 1:].permute(0, 1, 3, 4, 2), means[:, :, 0], any_valid


def seen_surfaces(batch: Batch) -> list[Float[Tensor, "_ 3"]]:
    """Points of the true surface seen in the input views, one per pixel of the subject with a known
    depth.

    Args:
        batch: with ``depths``.

    Returns:
        Points [_, 3] of each element, in the world, in metres.
    """
    points = unproject_maps(batch.depths, batch.cameras)
    known = batch.masks & (batch.depths > 0)
    return [of_element[seen] for of_element, seen in zip(points, known, strict=True)]
