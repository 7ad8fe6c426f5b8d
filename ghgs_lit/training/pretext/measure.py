"""Part-awareness of features: does the nearest neighbour in another view show the same part of the body?"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.geometry.vectors import unit


def neighbor_shows_part(
    features: Float[Tensor, "n c"], parts: Int[Tensor, " n"], views: Int[Tensor, " n"]
) -> Bool[Tensor, " n"]:
    """Whether the part of the most similar patch (cosine) among those of the other views is a patch's own.
    ``features``: of the patches of one person. ``views``: the view of each patch. Patches without another
    view are wrong."""
    directions = unit(features)
    cosines = (directions @ directions.T).masked_fill(views[:, None] == views, -torch.inf)
    best, nearest = cosines.max(1) if len(features) else (cosines.new_zeros(0), views)
    return (parts[nearest] == parts) & (best > -torch.inf)
