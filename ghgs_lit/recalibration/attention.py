"""Semantic-consistency attention over given neighbours (paper, Eqs. 3 to 5)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.projection import wide
from ghgs_lit.recalibration.neighbors import Neighbors

SIMILARITIES = ("product", "product_clamped", "log", "none")

#: Scores of all heads that are held at once where no gradient is kept.
_BLOCK = 1 << 23


class SemanticAttention(nn.Module):
    """``x + o(softmax(q . k / sqrt(d) * s) v)``, then a residual network; names as published.

    Args:
        dim: width C of the tokens; queries, keys and values have C / 4.
        num_heads: of width C / 4 / num_heads.
        similarity: how the cosine s of two tokens' semantic features acts on the logit:
            ``product`` multiplies (Eq. 3), ``product_clamped`` multiplies by max(s, 0) (the authors'
            release), ``log`` adds log(max(s, s_min)), which weighs dissimilar neighbours down in place of
            drawing their logit to 0, ``none`` ignores it (s = 1).
        s_min: the least similarity of ``log``.
    """

    def __init__(self, dim: int, num_heads: int = 8, similarity: str = "product", s_min: float = 0.01):
        super().__init__()
        choice("recalibration.similarity", similarity, SIMILARITIES)
        require(0 < s_min <= 1, "recalibration.s_min", "within (0, 1]", s_min)
        require(
            num_heads >= 1 and dim % (4 * num_heads) == 0,
            "recalibration.num_heads",
            f"heads that divide a quarter of the token width ({dim} / 4)",
            num_heads,
        )
        self.num_heads, self.similarity, self.s_min = num_heads, similarity, s_min
        inner = dim // 4
        self.norm1 = nn.LayerNorm(dim)
        self.q_proj = nn.Linear(dim, inner)
        self.k_proj = nn.Linear(dim, inner)
        self.v_proj = nn.Linear(dim, inner)
        self.o_proj = nn.Linear(inner, dim)
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, dim), nn.GELU(), nn.Linear(dim, dim))

    def forward(
        self,
        x: Float[Tensor, "N C"],
        neighbors: Sequence[Neighbors],
        cosines: Sequence[Tensor] | None,
    ) -> Float[Tensor, "N C"]:
        """Recalibrated tokens.

        Args:
            x: the tokens of all batch elements, one after the other.
            neighbors: of the ``n_b`` tokens of each element, as indices within the element.
            cosines: ``[n_b, k_b]`` for each element; None where ``similarity`` is ``none``.
        """
        counts = [len(element.index) for element in neighbors]
        normed = self.norm1(x)
        q, k, v = (projection(normed) for projection in (self.q_proj, self.k_proj, self.v_proj))
        parts = [
            self._attend(
                *(t.unflatten(1, (self.num_heads, -1)).transpose(0, 1) for t in element), near, cosine
            )
            for *element, near, cosine in zip(
                q.split(counts),
                k.split(counts),
                v.split(counts),
                neighbors,
                cosines if cosines is not None else [None] * len(counts),
                strict=True,
            )
        ]
        x = x + self.o_proj(torch.cat(parts))
        return x + self.mlp(self.norm2(x))

    def _attend(
        self,
        q: Float[Tensor, "a n d"],
        k: Float[Tensor, "a n d"],
        v: Float[Tensor, "a n d"],
        neighbors: Neighbors,
        cosine: Float[Tensor, "n k"] | None,
    ) -> Float[Tensor, "n c"]:
        """One element. All pairs are scored, then the neighbours' picked: no N x k x C is ever held."""
        n = q.shape[1]
        step = max(1, n if torch.is_grad_enabled() else _BLOCK // max(1, self.num_heads * n))
        parts = []
        for start in range(0, max(n, 1), step):
            block = slice(start, start + step)
            index = neighbors.index[None, block].expand(self.num_heads, -1, -1)
            scores = (q[:, block] * q.shape[-1] ** -0.5) @ k.mT
            logits = wide(scores.gather(2, index))
            if cosine is not None:
                logits = self._weigh(logits, cosine[block])
            logits = logits.masked_fill(~neighbors.valid[block], float("-inf"))
            # Invalid neighbours weigh 0 and may repeat a valid index, so weights are added, not set.
            weights = torch.zeros_like(scores, dtype=logits.dtype).scatter_add(2, index, logits.softmax(-1))
            parts.append((weights.to(v.dtype) @ v).transpose(0, 1).flatten(1))
        return torch.cat(parts)

    def _weigh(self, logits: Float[Tensor, "a m k"], cosine: Float[Tensor, "m k"]) -> Float[Tensor, "a m k"]:
        if self.similarity == "log":
            return logits + cosine.clamp(min=self.s_min).log()
        return logits * (cosine.clamp(min=0) if self.similarity == "product_clamped" else cosine)
