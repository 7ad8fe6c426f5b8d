"""CPU kernel of attention, compared with PyTorch in float64."""

import numba
import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.ops import pool
from ghgs_lit.ops.attention import WIDTH, attend, cpu
from ghgs_lit.ops.attention.cpu import KEYS, QUERIES
from ghgs_lit.ops.compile import processor_features
from ghgs_lit.ops.layers import PANEL, ROWS
from tests.helpers.processes import run_python

DTYPES = [torch.float32, torch.bfloat16]


def scene(n, heads, tokens, width, dtype, scale=1.0, seed=0):
    """Queries, keys and values [n, heads, tokens, width], views of one tensor as in the encoder."""
    g = torch.Generator().manual_seed(seed)
    qkv = torch.randn(n, tokens, 3, heads, width, generator=g)
    qkv[:, :, :2] *= scale
    return qkv.to(dtype).permute(2, 0, 3, 1, 4).unbind(0)


def error(found, q, k, v):
    """Root mean square of the error against float64, relative to the root mean square of the result."""
    expected = F.scaled_dot_product_attention(q.double(), k.double(), v.double()).transpose(1, 2)
    return ((found.double() - expected).square().mean() / expected.square().mean()).sqrt()


def limit(q, k, v):
    """Error budget of a kernel in ``ghgs stress``: a hundred times the effect of rounding the arguments
    once, plus one rounding, since PyTorch's error depends on a processor's order of summation."""
    g, eps = torch.Generator().manual_seed(1), torch.finfo(torch.float32).eps
    moved = [x.double() * (1 + eps * torch.randn(x.shape, generator=g).sign()) for x in (q, k, v)]
    return 100 * (eps + error(F.scaled_dot_product_attention(*moved).transpose(1, 2), q, k, v))


def pytorch(q, k, v):
    return F.scaled_dot_product_attention(q, k, v).transpose(1, 2)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("n", "heads", "tokens", "width"),
    [
        (1, 1, 1, 32),
        (2, 3, ROWS + 1, 64),
        (1, 2, 31, 96),
        (1, 2, KEYS - 1, 32),
        (2, 1, KEYS + 1, 64),
        (1, 2, 2 * KEYS + 77, 64),
        (1, 1, 3 * QUERIES + 5, 128),
    ],
)
def test_attention_is_as_near_as_pytorchs(n, heads, tokens, width, dtype):
    """The kernel is as accurate as the condition number allows, at all sizes around its block sizes."""
    for scale in (0.0, 1.0, 4.0):
        q, k, v = scene(n, heads, tokens, width, dtype, scale)
        found = cpu.attend_heads(q, k, v)
        assert found.dtype == dtype
        assert found.shape == (n, tokens, heads, width)
        if dtype == torch.float32:
            assert error(found, q, k, v) < limit(q, k, v)
        else:  # one rounding of the result
            assert error(found, q, k, v) < max(1.5 * error(pytorch(q, k, v), q, k, v), 2.0**-9)


def parts(queries, keys, dtype):
    q, k, v = scene(1, 2, 300, 64, dtype)
    return q[:, :, :queries], k[:, :, :keys], v[:, :, :keys]


def make_scores(keys):
    """Scores that rise or fall by hundreds: the running maximum changes in every block of keys, or only
    in the first."""
    v = scene(1, 1, 5 * KEYS, 32, torch.float32)[2]
    return torch.ones_like(v), keys(torch.linspace(-300, 300, 5 * KEYS)[:, None]).expand_as(v) / 32**0.5, v


def of_types(of_scores, of_values):
    q, k, v = scene(1, 2, 50, 32, torch.float32)
    return q.to(of_scores), k.to(of_scores), v.to(of_values)


def strided_channels():
    """The same values with channels that are not contiguous."""
    q, k, v = scene(1, 2, 50, 32, torch.float32)
    return tuple(x.transpose(2, 3).contiguous().transpose(2, 3) for x in (q, k, v))


INPUTS = {
    **{
        f"{queries} queries, {keys} keys, {dtype}": parts(queries, keys, dtype)
        for queries, keys in ((5, 300), (300, 7), (1, 1))
        for dtype in DTYPES
    },
    "rising": make_scores(lambda slope: slope),
    "falling": make_scores(lambda slope: -slope),
    "waves": make_scores(lambda slope: slope.sin() * 300),
    "values in float32": of_types(torch.bfloat16, torch.float32),
    "values in bfloat16": of_types(torch.float32, torch.bfloat16),
    "apart": strided_channels(),
}


@pytest.mark.parametrize("name", INPUTS)
def test_inputs_of_any_kind(name):
    """Cases cover different numbers of queries and keys, scores of any size, strides, and dtypes other than
    that of the values, which is the dtype of the result."""
    args = INPUTS[name]
    found = cpu.attend_heads(*args)
    assert found.dtype == args[2].dtype
    assert error(found, *args) < (limit(*args) if found.dtype == torch.float32 else 1e-2)


def test_weights_below_the_smallest_float_count_for_nothing():
    """Keys with tiny weights do not accumulate to an error, even with huge values."""
    q = torch.full((1, 1, 1, 32), 10.0)
    k = torch.zeros(1, 1, 64, 32)
    k[0, 0, 0] = 10
    v = torch.full_like(k, 1e6)
    v[0, 0, 0] = 1
    torch.testing.assert_close(cpu.attend_heads(q, k, v), torch.ones(1, 1, 1, 32), rtol=1e-6, atol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_what_is_not_finite_reaches_the_same_values_as_in_pytorch(dtype, bad):
    """NaN and infinity are neither hidden nor propagated to other queries or heads."""
    for part in range(3):
        q, k, v = (x.clone() for x in scene(1, 2, 300, 32, dtype))
        (q, k, v)[part][0, 1, 290, 3] = bad
        found = cpu.attend_heads(q, k, v)
        assert torch.equal(found.isnan(), pytorch(q.float(), k.float(), v.float()).isnan())
        assert found[:, :, 0].isfinite().all()


def test_what_the_kernel_is_asked_for(monkeypatch):
    """The kernel is used only where it is supported and faster."""
    monkeypatch.setattr(pool, "features", lambda: {"avx2", "fma"})
    q, _, v = scene(1, 4, 1024, 32, torch.float32)
    assert not attend.has_kernel(q, q, v, None)  # autograd is enabled
    with torch.no_grad():
        assert attend.has_kernel(q, q, v, None)
        assert not attend.has_kernel(q[:, :, :100], q[:, :, :100], v[:, :, :100], None)  # small
        assert not attend.has_kernel(q[..., :24], q[..., :24], v[..., :24], None)
        assert not attend.has_kernel(q.double(), q.double(), v.double(), None)
        assert not attend.has_kernel(q, q, v.half(), None)
        assert attend.has_kernel(q, q, v.bfloat16(), None)  # which is widened
        assert not attend.has_kernel(q.to("meta"), q.to("meta"), v.to("meta"), None)
        monkeypatch.setattr(pool, "features", lambda: {"avx2"})
        assert not attend.has_kernel(q, q, v, None)


def test_features_of_the_processor_may_be_limited(monkeypatch):
    """Processor features that a user disables in Numba's settings are not used."""
    monkeypatch.setattr(numba.config, "CPU_FEATURES", "+made_up,-avx512f")
    assert "made_up" in processor_features()
    assert "avx512f" not in processor_features()
    monkeypatch.setattr(numba.config, "CPU_NAME", "haswell")
    assert processor_features() == {"made_up"}


NARROW = """
import torch
import torch.nn.functional as F
from ghgs_lit.ops.attention import cpu
from ghgs_lit.ops.layers import PANEL, ROWS

assert (ROWS, PANEL) == (6, 16)
for n, heads, queries, keys, width in ((1, 1, 1, 1, 32), (2, 3, 7, 7, 64), (1, 2, 299, 333, 96)):
    g = torch.Generator().manual_seed(0)
    q, k, v = (torch.randn(n, heads, t, width, generator=g) for t in (queries, keys, keys))
    expected = F.scaled_dot_product_attention(q.double(), k.double(), v.double()).transpose(1, 2)
    assert (cpu.attend_heads(q, k, v) - expected).norm() < 6e-7 * expected.norm()
"""


def test_attention_without_512_bit_vectors():
    """The kernel for AVX2 is as accurate; Numba's settings select it on processors with AVX-512."""
    if not {"avx2", "fma"} <= processor_features():
        pytest.skip("needs AVX2")
    if "avx512f" in processor_features():
        run_python(NARROW, NUMBA_CPU_FEATURES="-avx512f")
    else:
        exec(NARROW, {})  # this processor has no AVX-512


def test_tiles_fit_the_blocks():
    """Blocks of queries are whole tiles and heads are whole panels on every processor."""
    assert QUERIES % ROWS == WIDTH % PANEL == KEYS % PANEL == 0
