"""Semantic-consistency attention over given neighbours (paper, Eqs. 3 to 5)."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.projection import wide
from ghgs_lit.linear import Linear, even_parts, product
from ghgs_lit.recalibration.neighbors import Neighbors

SIMILARITIES = ("product", "product_clamped", "log", "none")

#: Scores of one head, and rows of tokens, that are held at once where no gradient is kept.
_SCORES, _ROWS = 1 << 22, 512


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
        self.q_proj = Linear(dim, inner)
        self.k_proj = Linear(dim, inner)
        self.v_proj = Linear(dim, inner)
        self.o_proj = Linear(inner, dim)
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(Linear(dim, dim), nn.GELU(), Linear(dim, dim))

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
        return _by_rows(self._residual, x, self._gathered(x, neighbors, cosines))

    def _gathered(
        self, x: Float[Tensor, "N C"], neighbors: Sequence[Neighbors], cosines: Sequence[Tensor] | None
    ) -> Float[Tensor, "N i"]:
        """What every token takes from its neighbours."""
        counts = [len(element.index) for element in neighbors]
        parts = zip(
            *(t.split(counts) for t in self._queries_keys_values(x)),
            neighbors,
            cosines if cosines is not None else [None] * len(counts),
            strict=True,
        )
        found = [self._attend(*part) for part in parts]
        return found[0] if len(found) == 1 else torch.cat(found)

    def _queries_keys_values(self, x: Float[Tensor, "N C"]) -> list[Float[Tensor, "N i"]]:
        def project(part: Tensor) -> Tensor:
            normed = self.norm1(part)
            return torch.cat([p(normed) for p in (self.q_proj, self.k_proj, self.v_proj)], dim=-1)

        return list(_by_rows(project, x).chunk(3, dim=-1))

    def _residual(self, x: Float[Tensor, "N C"], y: Float[Tensor, "N i"]) -> Float[Tensor, "N C"]:
        x = x + self.o_proj(y)
        return x + self.mlp(self.norm2(x))

    def _attend(
        self,
        q: Float[Tensor, "n c"],
        k: Float[Tensor, "n c"],
        v: Float[Tensor, "n c"],
        neighbors: Neighbors,
        cosine: Float[Tensor, "n k"] | None,
    ) -> Float[Tensor, "n c"]:
        """One element, wide. All pairs are scored, then the neighbours' picked: no N x k x C is ever held."""
        with torch.autocast(q.device.type, enabled=False):
            q, k, v = (wide(t).unflatten(1, (self.num_heads, -1)).transpose(0, 1) for t in (q, k, v))
            if torch.is_grad_enabled():
                return self._mix(q, k, v, neighbors, cosine).transpose(0, 1).flatten(1)
            n = q.shape[1]
            y = q.new_empty(n, *q.shape[::2])
            # Head by head and block by block, so that the scores stay in a CPU's cache.
            for a in range(self.num_heads):
                keys, values = k[a : a + 1].contiguous(), v[a : a + 1].mT.contiguous().mT
                for rows in even_parts(n, _SCORES // max(1, n)):
                    near = Neighbors(neighbors.index[rows], neighbors.valid[rows])
                    weights = None if cosine is None else cosine[rows]
                    y[rows, a] = self._mix(q[a : a + 1, rows], keys, values, near, weights)[0]
            return y.flatten(1)

    def _mix(
        self,
        q: Float[Tensor, "a m d"],
        k: Float[Tensor, "a n d"],
        v: Float[Tensor, "a n d"],
        neighbors: Neighbors,
        cosine: Float[Tensor, "m k"] | None,
    ) -> Float[Tensor, "a m d"]:
        """Values of the neighbours of ``m`` queries, weighed by Eq. 3."""
        index = neighbors.index[None].expand(len(q), -1, -1)
        scores = _products(q * q.shape[-1] ** -0.5, k)
        logits = scores.gather(2, index)
        if cosine is not None:
            logits = self._weigh(logits, cosine)
        logits = logits.masked_fill(~neighbors.valid, float("-inf"))
        # Without a gradient nothing needs the scores any more, and weights take their place.
        weights = torch.zeros_like(scores) if torch.is_grad_enabled() else scores.zero_()
        # Invalid neighbours weigh 0 and may repeat a valid index, so weights are added, not set.
        weights = weights.scatter_add_(2, index, logits.softmax(-1))
        return _products(weights, v.mT)

    def _weigh(self, logits: Float[Tensor, "a m k"], cosine: Float[Tensor, "m k"]) -> Float[Tensor, "a m k"]:
        if self.similarity == "log":
            return logits + cosine.clamp(min=self.s_min).log()
        return logits * (cosine.clamp(min=0) if self.similarity == "product_clamped" else cosine)


def _products(x: Float[Tensor, "a m d"], y: Float[Tensor, "a n d"]) -> Float[Tensor, "a m n"]:
    """``x @ y.mT``; one head alone by the faster of a CPU's libraries."""
    return product(x[0], y[0])[None] if len(x) == 1 else x @ y.mT


def _by_rows(function: Callable[..., Tensor], *tensors: Float[Tensor, "N _"]) -> Float[Tensor, "N _"]:
    """``function(*tensors)`` of all rows, some at a time where no gradient is kept (bounds memory)."""
    count = len(tensors[0])
    if torch.is_grad_enabled() or count <= _ROWS:
        return function(*tensors)
    result = None
    for rows in even_parts(count, _ROWS):
        part = function(*(t[rows] for t in tensors))
        if result is None:
            result = part.new_empty(count, part.shape[1])
        result[rows] = part
    return result
