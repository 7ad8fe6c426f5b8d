"""Semantic-consistency attention to given neighbours (paper, Eqs. 3 to 5)."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from ghgs_lit.errors import require
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.ops.linear import Linear
from ghgs_lit.ops.pool import even_parts

#: How the similarity of two tokens changes their logit; see :class:`SemanticAttention`.
Similarity = Literal["product", "product_clamped", "log", "none"]

#: What logits are multiplied by, and what is added to them.
Changes = tuple[Tensor, Tensor]

#: The smallest similarity with ``log``, as its logarithm would be infinite at 0.
S_MIN = 0.01

#: Tokens computed at once without a gradient.
_ROWS = 424
#: The same in half precision, where a smaller number is as fast on a CPU.
_HALF_ROWS = 256
#: Largest number of scores of all tokens on a CPU.
_SCORES = 1 << 26
#: Largest number of gathered values of neighbours.
_GATHERED = 1 << 25


class SemanticAttention(nn.Module):
    """``x + o(softmax(q . k / sqrt(d) * s) v)``, then a residual MLP;
    parameters are named as published.

    Args:
        dim: width C of the tokens; queries, keys and values have C / 4 channels.
        num_heads: number of heads, each with C / 4 / num_heads channels.
        similarity: effect of the cosine s of two tokens' semantic features on the logit:
            ``product`` multiplies by s (Eq. 3), ``product_clamped`` by max(s, 0) (the authors'
            release), ``log`` adds log(max(s, S_MIN)), which lowers the weight of dissimilar
            neighbours instead of pulling their logit to 0, ``none`` ignores it (s = 1).
        has_places: whether the value of a neighbour also says where it lies from the query,
            by a linear map of the difference of their places that starts at 0 (not the
            paper's). By linearity that is the map of a head's mean place minus the query's:
            no tensor of all pairs.

    Raises:
        InputError: the heads do not divide C / 4."""

    def __init__(
        self, dim: int, num_heads: int = 8, similarity: Similarity = "product", has_places: bool = False
    ):
        super().__init__()
        expected = f"heads that divide a quarter of the token width ({dim} / 4)"
        require(dim % (4 * num_heads) == 0, "recalibration.num_heads", expected, num_heads)
        self.num_heads = num_heads
        self.similarity = similarity
        inner = dim // 4
        # on the CPU: not in checkpoints, need storage
        for name, value in (("one", 1.0), ("zero", 0.0)):
            self.register_buffer(name, torch.tensor(value, device="cpu"), persistent=False)
        self.norm1 = nn.LayerNorm(dim)
        self.q_proj = Linear(dim, inner)
        self.k_proj = Linear(dim, inner)
        self.v_proj = Linear(dim, inner)
        self.o_proj = Linear(inner, dim)
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = nn.Sequential(Linear(dim, dim), nn.GELU(), Linear(dim, dim))
        self.place_proj = None
        if has_places:
            self.place_proj = nn.Linear(3, inner, bias=False)
            nn.init.zeros_(self.place_proj.weight)

    def forward(
        self,
        x: Float[Tensor, "N C"],
        neighbors: Sequence[Tensor],
        cosines: Sequence[Tensor] | None,
        left_out: Float[Tensor, "N k"] | None = None,
        places: Sequence[Tensor] | None = None,
    ) -> Float[Tensor, "N C"]:
        """Recalibrated tokens.

        Args:
            x: the tokens of all elements, one after the other.
            neighbors: for each element [n_b, k_b], as indices in it.
            cosines: of the same shapes, if they are used.
            left_out: of one element, -inf where a neighbour does not count, else 0; one of each
                token counts at least; None: all.
            places: for each element [n_b, 3], in units of the subject; read with ``has_places``.

        Returns:
            Tokens [N, C] in the same order.
        """
        counts = [len(near) for near in neighbors]
        nothing = [None] * len(counts)
        elements = zip(x.split(counts), neighbors, cosines or nothing, places or nothing, strict=True)
        results = [self._recalibrate_element(*element, left_out) for element in elements]
        return results[0] if len(results) == 1 else torch.cat(results)

    def attention_weights(
        self, x: Float[Tensor, "n C"], rows: slice, near: Int[Tensor, "n k"], cosines: Tensor | None
    ) -> Float[Tensor, "m k a"]:
        """Softmax weights of each head from some tokens to their neighbours, for inspection.

        Args:
            x: the n tokens of one element [n, C].
            rows: which m tokens.
            near: neighbours of all n, as indices among them [n, k].
            cosines: of all n and their neighbours [n, k]; None: similarity is ignored (s = 1).

        Returns:
            Weights [m, k, a].
        """
        near = near[rows]
        normed = self.norm1(x)
        q = at_least_float32(self.q_proj(normed[rows]))
        k = at_least_float32(self.k_proj(normed))
        changes = self.factor_and_bias(None if cosines is None else cosines[rows])
        return self._weights(q, k[near], *(y.expand(near.shape) for y in changes))

    def _recalibrate_element(
        self,
        x: Float[Tensor, "n C"],
        near: Int[Tensor, "n k"],
        cosines: Float[Tensor, "n k"] | None,
        places: Float[Tensor, "n 3"] | None,
        left_out: Float[Tensor, "n k"] | None,
    ) -> Float[Tensor, "n C"]:
        """Recalibrate one element: keys and values of all tokens first, then the tokens in parts.

        Args:
            x: its tokens [n, C].
            near: neighbours of each, as indices among them [n, k].
            cosines: of tokens and neighbours [n, k], if they are used.
            places: of the tokens [n, 3]; None: values know none.
            left_out: -inf where a neighbour does not count, else 0 [n, k]; None: all count.

        Returns:
            Tokens [n, C].
        """
        linears = (self.q_proj, self.k_proj, self.v_proj, self.o_proj, self.mlp[0], self.mlp[2])
        q_proj, k_proj, v_proj, o_proj, mlp_in, mlp_out = map(_cast_once, linears)

        def keys_values(rows: slice) -> Float[Tensor, "m kv"]:
            normed = self.norm1(x[rows])
            return at_least_float32(torch.cat((k_proj(normed), v_proj(normed)), dim=-1))

        k, v = _in_parts(keys_values, len(x), x.device).chunk(2, dim=-1)
        if places is not None:
            places = places.to(v.dtype)
            v = self._with_places(v, places)

        def recalibrate(rows: slice) -> Float[Tensor, "m C"]:
            q = at_least_float32(q_proj(self.norm1(x[rows])))
            y = self._attend(q, k, v, near[rows], self._changes(cosines, left_out, rows))
            if places is not None:
                y = self._moved(y, places[rows])
            residual = x[rows] + o_proj(y)
            # One expression, so that the input of each layer is freed before the next one runs.
            return residual + mlp_out(self.mlp[1](mlp_in(self.norm2(residual))))

        return _in_parts(recalibrate, len(x), x.device)

    def _with_places(self, v: Float[Tensor, "n i"], places: Float[Tensor, "n 3"]) -> Float[Tensor, "n j"]:
        """Values with the place of their token behind the channels of each head, j = i + 3 a."""
        heads = v.unflatten(1, (self.num_heads, -1))
        return torch.cat((heads, places[:, None].expand(-1, self.num_heads, -1)), dim=-1).flatten(1)

    def _moved(self, y: Float[Tensor, "m j"], places: Float[Tensor, "m 3"]) -> Float[Tensor, "m i"]:
        """Weighted values of m tokens with what the places of their neighbours add,
        in float32 or wider.

        Args:
            y: weighted values of :meth:`_with_places`.
            places: of the m tokens.

        Returns:
            Values [m, i], heads concatenated.
        """
        values, mean = y.unflatten(1, (self.num_heads, -1)).tensor_split([-3], dim=-1)
        weight = self.place_proj.weight.to(y.dtype).unflatten(0, (self.num_heads, -1))
        with exact(y.device.type):
            return (values + torch.einsum("max,aix->mai", mean - places[:, None], weight)).flatten(1)

    def _attend(
        self,
        q: Float[Tensor, "m i"],
        k: Float[Tensor, "n i"],
        v: Float[Tensor, "n j"],
        near: Int[Tensor, "m k"],
        changes: Changes | None,
    ) -> Float[Tensor, "m j"]:
        """Weighted values of the neighbours of ``m`` tokens (Eq. 3), in float32 or wider.

        On a CPU by a product with all tokens: faster than gathering,
        without a tensor of size m x k x C.

        Args:
            q: queries of these tokens [m, i].
            k: keys of all tokens of the element [n, i].
            v: their values [n, j].
            near: neighbours of the m tokens [m, k].
            changes: what logits are multiplied by, and what is added [m, k]; None: nothing.

        Returns:
            Values [m, j], heads concatenated.
        """
        with exact(q.device.type):
            if q.device.type != "cpu" or self.num_heads * len(q) * len(k) > _SCORES:
                return self._attend_gathered(q, k, v, near, changes or self.factor_and_bias(None))
            q, k, v = (t.unflatten(1, (self.num_heads, -1)).transpose(0, 1) for t in (q, k, v))
            index = near[None].expand(len(q), -1, -1)
            scores = q * q.shape[-1] ** -0.5 @ k.mT
            logits = scores.gather(2, index)
            if changes is not None:
                logits = logits * changes[0] + changes[1]
            # Without a gradient the weights reuse the memory of the scores.
            weights = torch.zeros_like(scores) if torch.is_grad_enabled() else scores.zero_()
            weights = weights.scatter_(2, index, logits.softmax(-1))
            return (weights @ v).transpose(0, 1).flatten(1)

    def _attend_gathered(
        self,
        q: Float[Tensor, "m i"],
        k: Float[Tensor, "n i"],
        v: Float[Tensor, "n j"],
        near: Int[Tensor, "m k"],
        changes: Changes,
    ) -> Float[Tensor, "m j"]:
        """Eq. 3 with gathered keys and values of neighbours;
        nothing is as large as the square of the tokens.

        If there are several parts, the backward pass computes each again.

        Args:
            q: queries of m tokens [m, i].
            k: keys of all tokens of the element [n, i].
            v: their values [n, j].
            near: neighbours of the m tokens [m, k].
            changes: what logits are multiplied by, and what is added,
                of shapes that broadcast to [m, k].

        Returns:
            Values [m, j], heads concatenated.
        """
        factor, bias = (x.expand(near.shape) for x in changes)

        def attend(q: Tensor, k: Tensor, v: Tensor, index: Tensor, *others: Tensor) -> Tensor:
            """Weighted values of the neighbours of a part of the tokens.

            Args:
                q: queries of the part [p, i].
                k: keys of all tokens of the element [n, i].
                v: their values [n, j].
                index: neighbours of the part's tokens [p, k].
                others: factor and bias of their logits [p, k].

            Returns:
                Values [p, j], heads concatenated.
            """
            weights = self._weights(q, k[index], *others)
            return (weights[..., None] * v[index].unflatten(-1, (self.num_heads, -1))).sum(1).flatten(1)

        rows = even_parts(len(q), _GATHERED // max(1, near.shape[1] * q.shape[1]))
        parts = []
        for part in rows:
            inputs = (q[part], k, v, *(x[part] for x in (near, factor, bias)))
            if len(rows) > 1 and torch.is_grad_enabled():
                parts.append(checkpoint(attend, *inputs, use_reentrant=False, preserve_rng_state=False))
            else:
                parts.append(attend(*inputs))
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    def _weights(
        self,
        q: Float[Tensor, "m i"],
        k: Float[Tensor, "m k i"],
        factor: Float[Tensor, "m k"],
        bias: Float[Tensor, "m k"],
    ) -> Float[Tensor, "m k a"]:
        """Softmax weights, in each head, of the neighbours of ``m`` tokens.

        Args:
            q: queries of the tokens [m, i].
            k: keys of their neighbours [m, k, i].
            factor: what logits are multiplied by [m, k].
            bias: what is added to them [m, k].

        Returns:
            Weights [m, k, a].
        """
        products = (q[:, None] * k).unflatten(-1, (self.num_heads, -1)).sum(-1)
        logits = products * (q.shape[1] // self.num_heads) ** -0.5 * factor[..., None] + bias[..., None]
        return logits.softmax(1)

    def _changes(self, cosines: Tensor | None, left_out: Tensor | None, rows: slice) -> Changes | None:
        """:meth:`factor_and_bias` of some tokens, with -inf for neighbours that are left out.

        Args:
            cosines: of all tokens and their neighbours [n, k], if they are used.
            left_out: -inf where a neighbour does not count, else 0 [n, k]; None: all count.
            rows: which m tokens.

        Returns:
            Both, of shapes that broadcast to [m, k]; None: logits stay.
        """
        if cosines is None and left_out is None:
            return None
        factor, bias = self.factor_and_bias(None if cosines is None else cosines[rows])
        if left_out is None:
            return factor, bias
        return factor, left_out[rows] if bias is self.zero else bias + left_out[rows]

    def factor_and_bias(self, cosines: Float[Tensor, "*n"] | None) -> Changes:
        """What the semantic similarity multiplies a logit by, and what it adds.

        Args:
            cosines: of tokens and neighbours, in [-1, 1]; None: similarity is ignored (s = 1).

        Returns:
            Two tensors of the shape of ``cosines``, or scalars 1 and 0.
        """
        if cosines is None:
            return self.one, self.zero
        if self.similarity == "log":
            return self.one, cosines.clamp(min=S_MIN).log()
        return (cosines.clamp(min=0) if self.similarity == "product_clamped" else cosines), self.zero


def _cast_once(linear: nn.Linear) -> Callable[[Tensor], Tensor]:
    """``linear`` with its parameters cast to autocast's dtype once,
    not for every part of the tokens."""
    kind = linear.weight.device.type
    if not torch.is_autocast_enabled(kind):
        return linear
    dtype = torch.get_autocast_dtype(kind)
    return partial(F.linear, weight=linear.weight.to(dtype), bias=linear.bias.to(dtype))


def _in_parts(
    function: Callable[[slice], Tensor], count: int, device: torch.device
) -> Float[Tensor, "count _"]:
    """``function`` of all rows; on a CPU without a gradient a part of them at a time,
    to save memory.

    Args:
        function: rows to values [m, _].
        count: number of all rows.
        device: that of the values.

    Returns:
        Values [count, _].
    """
    most = _HALF_ROWS if torch.is_autocast_enabled("cpu") else _ROWS
    if torch.is_grad_enabled() or count <= most or device.type != "cpu":
        return function(slice(None))
    result = None
    for rows in even_parts(count, most):
        part = function(rows)
        if result is None:
            result = part.new_empty(count, part.shape[1])
        result[rows] = part
    return result
