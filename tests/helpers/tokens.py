"""Tokens with points for the recalibration stage, and their neighbours by definition."""

import numpy as np
import torch
import torch.nn.functional as F

from ghgs_lit.method.recalibration import RecalibrationOptions
from ghgs_lit.method.recalibration.recalibration import S_MIN
from ghgs_lit.types import Points, Tokens
from tests.helpers.plans import with_plan


def literal_neighbors(points, i, k):
    """Indices of the neighbours of point ``i``, computed from the definition in float64."""
    distance = np.linalg.norm(points.double().numpy() - points[i].double().numpy(), axis=1)
    return sorted(range(len(points)), key=lambda j: (np.float32(distance[j]), j))[:k]


def literal_attention(block, x, points, semantic, k):
    """Eqs. 3 to 5 and the residual network for one element, one query, head and neighbour at a time."""
    around = points - points.mean(0)
    places = around / around.square().sum(1).mean().sqrt()
    normed = block.norm1(x)
    q, key, v = (
        layer(normed).unflatten(1, (block.num_heads, -1))
        for layer in (block.q_proj, block.k_proj, block.v_proj)
    )
    rows = []
    for i in range(len(x)):
        near = literal_neighbors(points, i, k)
        heads = []
        for a in range(block.num_heads):
            scores, values = [], []
            for j in near:
                score = q[i, a] @ key[j, a] / q.shape[-1] ** 0.5
                s = F.cosine_similarity(semantic[i], semantic[j], dim=0)
                score = {
                    "product": score * s,
                    "product_clamped": score * s.clamp(min=0),
                    "log": score + s.clamp(min=S_MIN).log(),
                    "none": score,
                }[block.similarity]
                value = v[j, a]
                if block.place_proj is not None:
                    of_places = block.place_proj.weight.unflatten(0, (block.num_heads, -1))
                    value = value + of_places[a] @ (places[j] - places[i])
                scores.append(score)
                values.append(value)
            heads.append(torch.stack(scores).softmax(0) @ torch.stack(values))
        rows.append(torch.cat(heads))
    x = x + block.o_proj(torch.stack(rows))
    return x + block.mlp(block.norm2(x))


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
