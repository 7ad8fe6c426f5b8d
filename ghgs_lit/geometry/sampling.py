"""Values of maps between their pixels."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor


def sample(
    maps: Float[Tensor, "m c H W"], image: Int[Tensor, "*n"], pixels: Float[Tensor, "*n 2"]
) -> Float[Tensor, "*n c"]:
    """Bilinear values of the maps ``image`` at ``pixels`` (u, v); 0 outside.

    The maps must be finite: a rounding of the next map enters, too.
    """
    count, _, height, width = maps.shape
    u, v = pixels.unbind(-1)
    # The maps are the layers of a volume, and all pixels lie in the middle of a layer. Far outside is brought
    # near: large numbers are not exact.
    layer = (2 * image.to(pixels) + 1) / count - 1
    grid = torch.stack(((2 / width * u - 1).clamp(-3, 3), (2 / height * v - 1).clamp(-3, 3), layer), -1)
    grid = grid.reshape(1, 1, 1, -1, 3)
    found = F.grid_sample(maps.transpose(0, 1)[None], grid, align_corners=False)
    return found[0, :, 0, 0].mT.reshape(*image.shape, maps.shape[1])
