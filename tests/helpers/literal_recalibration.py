"""The recalibration as written in the paper, one layer per call, without shared neighbours or cosines."""

import torch
import torch.nn.functional as F


def literal_recalibration(block, x, points, semantic, k):
    """Recalibrate the tokens of one batch element.

    Keys, values and features of the neighbours are gathered, [n, k, ...] each.

    Args:
        block: the ``SemanticAttention`` whose parameters are used.
        x: tokens [n, C].
        points: positions in space [n, 3]; neighbours may be in any view.
        semantic: semantic features [n, s].
        k: number of neighbours.
    """
    near = torch.cat(
        [torch.cdist(part, points).topk(k, largest=False).indices for part in points.split(1024)]
    )
    normed = block.norm1(x)
    q, key, v = (
        F.linear(normed, p.weight, p.bias).unflatten(1, (block.num_heads, -1))
        for p in (block.q_proj, block.k_proj, block.v_proj)
    )
    neighbor = F.normalize(semantic[near], dim=-1)
    s = (F.normalize(semantic, dim=-1)[:, None] * neighbor).sum(-1)
    scores = (q[:, None] * key[near]).sum(-1) / q.shape[-1] ** 0.5
    weights = (scores * s.clamp(min=0)[..., None]).softmax(1)
    y = (weights[..., None] * v[near]).sum(1).flatten(1)
    x = x + F.linear(y, block.o_proj.weight, block.o_proj.bias)
    first, _, second = block.mlp
    hidden = F.gelu(F.linear(block.norm2(x), first.weight, first.bias))
    return x + F.linear(hidden, second.weight, second.bias)
