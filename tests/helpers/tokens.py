"""Tokens with points for the recalibration stage, and their neighbours by definition."""

import numpy as np
import torch

from ghgs_lit.method.recalibration import RecalibrationOptions
from ghgs_lit.types import Points, Tokens
from tests.helpers.plans import with_plan


def literal_neighbors(points, i, k):
    """Indices of the neighbours of point ``i``, computed from the definition in float64."""
    distance = np.linalg.norm(points.double().numpy() - points[i].double().numpy(), axis=1)
    return sorted(range(len(points)), key=lambda j: (np.float32(distance[j]), j))[:k]


def scene(counts=((4, 5, 3), (6, 2, 5)), dim=32, grid=(4, 4), seed=0, dtype=torch.float32):
    """Tokens and points; ``counts[b][v]`` tokens are valid in view v of element b."""
    generator = torch.Generator().manual_seed(seed)
    b, v = len(counts), len(counts[0])
    n = b * v * grid[0] * grid[1]
    axes = (torch.arange(m) for m in (b * v, *grid))
    image, row, column = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
    valid = torch.zeros(b * v, grid[0] * grid[1], dtype=torch.bool)
    for index, count in enumerate(c for element in counts for c in element):
        valid[index, torch.randperm(grid[0] * grid[1], generator=generator)[:count]] = True
    latent = tuple(torch.randn(n, dim, generator=generator, dtype=dtype) for _ in range(4))
    semantic = torch.randn(n, 12, generator=generator, dtype=dtype)
    tokens = Tokens(latent, semantic, image, row, column, (b, v, *grid), 2)
    height, width = 2 * grid[0], 2 * grid[1]
    masks = torch.ones(b, v, height, width, dtype=torch.bool)
    points = Points(
        torch.zeros(b, v, height, width, 3),
        masks,
        torch.randn(n, 3, generator=generator),
        valid.flatten(),
        image,
    )
    return tokens, points


def make_stage(dim=32, k=4, num_heads=2, **options):
    torch.manual_seed(2)
    return with_plan(RecalibrationOptions(k=k, num_heads=num_heads, **options).build(dim))
