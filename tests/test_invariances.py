"""Results must not change beyond rounding with the number of threads and the precision of products."""

import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.method.recalibration import Neighborhood, SemanticAttention
from ghgs_lit.ops.attention import cpu
from ghgs_lit.ops.compile import processor_features
from ghgs_lit.ops.neighbors import nearest_neighbors, neighbor_cosines
from tests.helpers.models import close, make_model, predict
from tests.helpers.scenes import make_batch
from tests.helpers.tokens import literal_attention


@pytest.mark.parametrize("name", ["paper", "recurrent"])
def test_two_threads_predict_what_one_does(name):
    """Only the order of summation may differ."""
    model, batch, before = (
        make_model(f"model={name}").eval(),
        make_batch(2, 3, 56, 42),
        torch.get_num_threads(),
    )
    found = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            with torch.no_grad():
                found.append(predict(model, batch))
    finally:
        torch.set_num_threads(before)
    close(found[1].gaussians, found[0].gaussians)
    assert (found[1].depth - found[0].depth).abs().max() <= 1e-5 * found[0].depth.abs().max()


def attention(g):
    q, k, v = (torch.randn(2, 3, 200, 64, generator=g) for _ in range(3))

    def ours(dtype):
        return cpu.attend_heads(*(x.to(dtype) for x in (q, k, v)))

    def plain(dtype):
        return F.scaled_dot_product_attention(*(x.to(dtype) for x in (q, k, v))).transpose(1, 2)

    return ours, plain


def recalibration(g):
    block = SemanticAttention(64, 2, "product_clamped")
    x, points, semantic = (torch.randn(300, n, generator=g) for n in (64, 3, 16))
    near = nearest_neighbors(points, torch.zeros(300, dtype=torch.long), 8)

    @torch.no_grad()
    def ours(dtype):
        with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
            return block(x, Neighborhood(near, neighbor_cosines(semantic, near)))

    @torch.no_grad()
    def plain(dtype):
        with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
            return literal_attention(block, x, points, semantic, 8)

    return ours, plain


HALF = pytest.mark.skipif("avx512bf16" not in processor_features(), reason="no products in bfloat16")


@pytest.mark.parametrize("case", [pytest.param(attention, marks=HALF), recalibration])
def test_mixed_precision_costs_at_most_twice_what_it_costs_pytorch(case):
    """At most twice ``|out - ref|`` of the same function in plain PyTorch at that dtype, plus 1e-5 of
    ``|ref|``.

    Root mean squares, because the largest rounding error depends on a processor's order of summation.
    """
    ours, plain = case(torch.Generator().manual_seed(0))
    expected = plain(torch.float32)
    allowed = 2 * (plain(torch.bfloat16).float() - expected).norm() + 1e-5 * expected.norm()
    assert (ours(torch.bfloat16).float() - expected).norm() <= allowed
