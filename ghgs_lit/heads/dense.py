"""Dense heads whose widths follow the encoder's, run on some of the views."""

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.heads.dpt import DPTHead
from ghgs_lit.types import Tokens


def proportioned_dpt(
    dim_latent: int,
    output_dim: int,
    features: int | None = None,
    out_channels: Sequence[int] | None = None,
    **options,
) -> DPTHead:
    """A :class:`DPTHead` whose widths keep the published proportions to its tokens.

    Args:
        dim_latent: width of the tokens, 2048 as published.
        output_dim: channels of the result.
        features: None for 1/8 of the tokens' width (256 as published).
        out_channels: None for 1/8, 1/4, 1/2 and 1/2 of it (256, 512, 1024, 1024 as published).
        options: further options of :class:`DPTHead`.
    """
    if features is None:
        features = _multiple(dim_latent / 8, 8)
    if out_channels is None:
        out_channels = [_multiple(dim_latent * part, 4) for part in (1 / 8, 1 / 4, 1 / 2, 1 / 2)]
    return DPTHead(dim_latent, features, out_channels, output_dim, **options)


def decode_views(
    dpt: DPTHead,
    tokens: Tokens,
    guide: Float[Tensor, "b v k H W"] | None,
    wanted: Bool[Tensor, "b v"],
) -> Float[Tensor, "bv o H W"]:
    """Maps of the images that are ``wanted``; 0 for the others, which ``dpt`` does not see.

    Args:
        dpt: the dense head.
        tokens: of all images.
        guide: of all images, for a head with a guide.
        wanted: where none is, all images are decoded: the maps keep their shape and a gradient of 0.
    """
    flat = wanted.flatten()
    if flat.all() or not flat.any():
        return dpt(tokens, guide)
    kept = flat.nonzero()[:, 0]
    part = tokens.select(flat[tokens.image])
    part = dataclasses.replace(
        part, image=(flat.cumsum(0) - 1)[part.image], grid=(1, len(kept), *tokens.grid[2:])
    )
    maps = dpt(part, None if guide is None else guide.flatten(0, 1)[kept][None])
    return torch.zeros(len(flat), *maps.shape[1:], dtype=maps.dtype, device=maps.device).index_copy(
        0, kept, maps
    )


def _multiple(value: float, of: int) -> int:
    return max(of, of * round(value / of))
