"""A dense head in the published proportions to its encoder, on the views that are wanted."""

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
    """A :class:`DPTHead` for tokens of width ``dim_latent``.

    Widths that are not given follow the published ones, which are fractions of the tokens' 2048:
    features 1/8 (256), levels 1/8, 1/4, 1/2 and 1/2 (256, 512, 1024, 1024).
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
    """What ``dpt`` makes of the images that are ``wanted``; 0 for the others, which it does not see.

    Where none is wanted all are decoded: a shape for what follows, and gradients of 0.
    """
    flat = wanted.flatten()
    if flat.all() or not flat.any():
        return dpt(tokens, guide)
    kept = flat.nonzero()[:, 0]
    chosen = flat[tokens.image]
    part = dataclasses.replace(
        tokens,
        latent=tuple(layer[chosen] for layer in tokens.latent),
        semantic=tokens.semantic[chosen],
        image=(flat.cumsum(0) - 1)[tokens.image[chosen]],
        row=tokens.row[chosen],
        column=tokens.column[chosen],
        grid=(1, len(kept), *tokens.grid[2:]),
    )
    maps = dpt(part, None if guide is None else guide.flatten(0, 1)[kept][None])
    return torch.zeros(len(flat), *maps.shape[1:], dtype=maps.dtype, device=maps.device).index_copy(
        0, kept, maps
    )


def _multiple(value: float, of: int) -> int:
    return max(of, of * round(value / of))
