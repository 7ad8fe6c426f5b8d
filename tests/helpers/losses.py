"""Losses with single terms."""

from ghgs_lit.losses import Losses, LossWeights


def losses_of(weights: dict[str, float], **options) -> Losses:
    """Losses with these weights; all other terms have weight 0."""
    return Losses(weights={**dict.fromkeys(LossWeights.model_fields, 0.0), **weights}, **options)
