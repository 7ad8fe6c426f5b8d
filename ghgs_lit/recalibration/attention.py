"""Semantic-consistency attention over given neighbours (paper, Eqs. 3 to 5)."""

from collections.abc import Callable, Sequence
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.kernels.linear import Linear
from ghgs_lit.kernels.parts import even_parts
from ghgs_lit.recalibration import cpu
from ghgs_lit.recalibration.neighbors import Neighbors

SIMILARITIES = ("product", "product_clamped", "log", "none")

#: Tokens that are handled at once where no gradient is kept: in half precision, fewer are as fast on a CPU.
_ROWS, _HALF_ROWS = 424, 256


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
        counts = [len(element.index) for element in neighbors]
        parts = zip(x.split(counts), neighbors, cosines or [None] * len(counts), strict=True)
        found = [self._recalibrated(*part) for part in parts]
        return found[0] if len(found) == 1 else torch.cat(found)

    def _recalibrated(
        self, x: Float[Tensor, "n C"], neighbors: Neighbors, cosine: Float[Tensor, "n k"] | None
    ) -> Float[Tensor, "n C"]:
        """One element: keys and values of all, then some tokens at a time."""
        linears = (self.q_proj, self.k_proj, self.v_proj, self.o_proj, self.mlp[0], self.mlp[2])
        ask, key, value, answer, first, second = map(_ready, linears)

        def keys_values(rows: slice) -> Float[Tensor, "m kv"]:
            normed = self.norm1(x[rows])
            return at_least_float32(torch.cat((key(normed), value(normed)), dim=-1))

        k, v = _by_rows(keys_values, len(x)).chunk(2, dim=-1)

        def recalibrate(rows: slice) -> Float[Tensor, "m C"]:
            near = Neighbors(neighbors.index[rows], neighbors.valid[rows])
            q = at_least_float32(ask(self.norm1(x[rows])))
            y = self._attend(q, k, v, near, None if cosine is None else cosine[rows])
            residual = x[rows] + answer(y)
            # Layer by layer: what one has read is freed before the next one runs.
            return residual + second(self.mlp[1](first(self.norm2(residual))))

        return _by_rows(recalibrate, len(x))

    def _attend(
        self,
        q: Float[Tensor, "m i"],
        k: Float[Tensor, "n i"],
        v: Float[Tensor, "n i"],
        neighbors: Neighbors,
        cosine: Float[Tensor, "m k"] | None,
    ) -> Float[Tensor, "m i"]:
        """What ``m`` tokens take from their neighbours. Elsewhere than on a CPU, all pairs are scored, then
        the neighbours' picked: a product of all is faster than gathers, and no m x k x C is ever held."""
        with torch.autocast(q.device.type, enabled=False):
            if cpu.is_supported(q, self.num_heads, neighbors.index.shape[1]):
                influence = (x.expand(neighbors.index.shape) for x in self._influence(cosine))
                return cpu.attend(q, k, v, self.num_heads, neighbors.index, neighbors.valid, *influence)
            q, k, v = (t.unflatten(1, (self.num_heads, -1)).transpose(0, 1) for t in (q, k, v))
            return self._mix(q, k, v, neighbors, cosine).transpose(0, 1).flatten(1)

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
        scores = q * q.shape[-1] ** -0.5 @ k.mT
        logits = scores.gather(2, index)
        if cosine is not None:
            logits = self._weigh(logits, cosine)
        logits = logits.masked_fill(~neighbors.valid, float("-inf"))
        # Without a gradient nothing needs the scores any more, and weights take their place.
        weights = torch.zeros_like(scores) if torch.is_grad_enabled() else scores.zero_()
        # Invalid neighbours weigh 0 and may repeat a valid index, so weights are added, not set.
        weights = weights.scatter_add_(2, index, logits.softmax(-1))
        return weights @ v

    def _weigh(self, logits: Float[Tensor, "a m k"], cosine: Float[Tensor, "m k"]) -> Float[Tensor, "a m k"]:
        factor, term = self._influence(cosine)
        return logits * factor + term

    def _influence(self, cosine: Float[Tensor, "m k"] | None) -> tuple[Tensor, Tensor]:
        """What logits are multiplied by, and what is added to them."""
        one = torch.ones((), device=cosine.device if cosine is not None else None)
        if cosine is None:
            return one, one * 0
        if self.similarity == "log":
            return one, cosine.clamp(min=self.s_min).log()
        return (cosine.clamp(min=0) if self.similarity == "product_clamped" else cosine), one * 0


def _ready(linear: nn.Linear) -> Callable[[Tensor], Tensor]:
    """``linear`` with its numbers in autocast's type: cast once, not again for every part of the tokens."""
    kind = linear.weight.device.type
    if not torch.is_autocast_enabled(kind):
        return linear
    dtype = torch.get_autocast_dtype(kind)
    return partial(F.linear, weight=linear.weight.to(dtype), bias=linear.bias.to(dtype))


def _by_rows(function: Callable[[slice], Tensor], count: int) -> Float[Tensor, "count _"]:
    """``function`` of all rows, some at a time where no gradient is kept (bounds memory)."""
    most = _HALF_ROWS if torch.is_autocast_enabled("cpu") else _ROWS
    if torch.is_grad_enabled() or count <= most:
        return function(slice(None))
    result = None
    for rows in even_parts(count, most):
        part = function(rows)
        if result is None:
            result = part.new_empty(count, part.shape[1])
        result[rows] = part
    return result
