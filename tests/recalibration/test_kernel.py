"""The CPU kernels for attention over neighbours: against float64, and inside the module."""

import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.recalibration import MODES, SIMILARITIES, cpu
from tests.helpers.tokens import make_stage, scene


def neighborhood(n=37, c=64, k=9, seed=0, scale=1.0):
    """Queries, keys and values (parts of one tensor), neighbours (some invalid), factors and biases."""
    g = torch.Generator().manual_seed(seed)
    qkv = torch.randn(n, 3 * c, generator=g) * scale
    index = torch.stack([torch.randperm(n, generator=g)[:k] for _ in range(n)])
    valid = torch.rand(n, k, generator=g) < 0.7
    valid[:, 0] = True
    factor, bias = torch.randn(n, k, generator=g), torch.randn(n, k, generator=g)
    return *qkv.chunk(3, dim=-1), index, valid, factor, bias


def gathered(q, k, v, heads, index, valid, factor, bias):
    """Eq. 3 with gathered keys and values."""
    q, k, v = (x.unflatten(1, (heads, -1)) for x in (q, k, v))
    logits = torch.einsum("nad,nkad->nak", q, k[index]) / q.shape[-1] ** 0.5
    logits = logits * factor[:, None] + bias[:, None]
    weights = logits.masked_fill(~valid[:, None], float("-inf")).softmax(-1)
    return torch.einsum("nak,nkad->nad", weights, v[index]).flatten(1)


def double(arguments):
    return [x.double() if torch.is_tensor(x) and x.is_floating_point() else x for x in arguments]


@pytest.mark.parametrize(("c", "heads"), [(16, 1), (64, 4), (64, 1), (96, 2), (512, 8)])
@pytest.mark.parametrize("k", [1, 7, 16, 33])
def test_attention_over_neighbors(c, heads, k):
    """The kernel equals gathering in float64 for all widths and numbers of neighbours."""
    q, key, v, *rest = neighborhood(c=c, k=k)
    arguments = q, key, v, heads, *rest
    expected = gathered(*double(arguments))
    torch.testing.assert_close(cpu.attend(*arguments).double(), expected, atol=3e-6, rtol=1e-5)


def test_large_logits():
    """Logits of thousands do not overflow, and the kernel is as accurate as PyTorch."""
    q, key, v, *rest = neighborhood(k=33, scale=100)
    arguments = q, key, v, 2, *rest
    expected, own = gathered(*double(arguments)), gathered(*arguments)
    assert (cpu.attend(*arguments) - expected).abs().max() < 2 * (own - expected).abs().max() + 1e-4


def test_who_is_no_neighbor_has_no_say():
    """Invalid neighbours have no influence, even where their values are NaN."""
    q, key, v, index, valid, factor, bias = neighborhood()
    expected = cpu.attend(q, key, v, 2, index, valid, factor, bias)
    index = torch.where(valid, index, torch.full_like(index, 36))
    met = (index == 36) & valid
    key, v = key.clone(), v.clone()
    key[36] = v[36] = float("nan")
    found = cpu.attend(q, key, v, 2, index, valid, factor, bias)
    assert torch.equal(found.isnan().any(1), met.any(1))
    assert torch.equal(found[~met.any(1)], expected[~met.any(1)])


def test_no_neighbor_at_all_is_undefined_as_in_a_softmax_of_nothing():
    """A token without a valid neighbour gives NaN, and only that token."""
    q, key, v, index, valid, factor, bias = neighborhood()
    valid[5] = False
    found = cpu.attend(q, key, v, 2, index, valid, factor, bias)
    assert found[5].isnan().all()
    assert found.isfinite().all(1).sum() == 36


@pytest.mark.parametrize("scale", [1e-20, 1e-15, 1.0, 1e15])
def test_cosines(scale):
    """Cosines are accurate for features of any length, and 0 for a zero feature."""
    g = torch.Generator().manual_seed(0)
    features = torch.randn(50, 48, generator=g) * scale
    index = torch.randint(50, (50, 5), generator=g)
    index[:, 0] = torch.arange(50)
    if scale == 1:
        features[7] = 0
    expected = F.normalize(features.double(), dim=-1, eps=1e-30)
    expected = (expected[:, None] * expected[index]).sum(-1)
    torch.testing.assert_close(cpu.cosines(features, index).double(), expected, atol=3e-7, rtol=0)


def test_the_same_bits_with_any_number_of_threads():
    """Results do not depend on the number of threads."""
    before = torch.get_num_threads()
    q, key, v, *rest = neighborhood(n=700, k=16)
    found = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found.append((cpu.attend(q, key, v, 4, *rest), cpu.cosines(v, rest[0])))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(other, found[0], strict=True))


@pytest.mark.parametrize("similarity", SIMILARITIES)
@pytest.mark.parametrize("neighbors", MODES)
def test_the_module_without_a_gradient_is_the_same(monkeypatch, similarity, neighbors):
    """Inference by the kernels equals the module with a gradient, for every option."""
    tokens, points = scene(dim=128)
    tokens = type(tokens)(tokens.latent, torch.randn(96, 32), *list(vars(tokens).values())[2:])
    module = make_stage(dim=128, similarity=similarity, neighbors=neighbors)
    expected = module(tokens, points)
    calls = []
    for name in ("attend", "cosines"):
        kernel = getattr(cpu, name)
        monkeypatch.setattr(cpu, name, lambda *a, kernel=kernel, name=name: calls.append(name) or kernel(*a))
    monkeypatch.setattr("ghgs_lit.recalibration.cpu.attention._LARGE", 0)
    with torch.no_grad():
        found = module(tokens, points)
    assert set(calls) == {"attend"} | ({"cosines"} if similarity != "none" else set())
    for mine, own in zip(found.latent, expected.latent, strict=True):
        torch.testing.assert_close(mine, own.detach(), atol=1e-5, rtol=1e-5)


def test_what_the_kernels_are_asked_for():
    """The kernels are used only where they are supported and faster."""
    x = torch.randn(1024, 128)
    assert not cpu.is_supported(x, 8, 64)  # a gradient may be needed
    with torch.no_grad():
        assert cpu.is_supported(x, 8, 64)
        assert not cpu.is_supported(x, 16, 64)  # eight numbers a head
        assert not cpu.is_supported(x, 8, 1)  # small
        assert not cpu.is_supported(x.double(), 8, 64)
        assert not cpu.is_supported(x.to("meta"), 8, 64)
