"""A dense head in the published proportions to its encoder."""

from collections.abc import Sequence

from ghgs_lit.heads.dpt import DPTHead


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


def _multiple(value: float, of: int) -> int:
    return max(of, of * round(value / of))
