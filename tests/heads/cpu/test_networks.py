"""The kernel of the networks of attributes against plain PyTorch."""

import pytest
import torch

from ghgs_lit.heads import cpu
from tests.heads.test_gaussian import make_head, shake


def networks(channels, hidden):
    head = make_head(channels=channels, hidden=hidden, guide=True, color_limit=0.5)
    for name, values in head.named_parameters():
        if "header" in name:
            torch.nn.init.normal_(values, std=0.3)
    return [head.offset_header, head.scale_header, head.rot_header, head.opacity_header, head.color_header]


@pytest.mark.parametrize(("channels", "hidden"), [(16, (32, 16)), (32, (128, 32)), (5, (3, 7))])
@pytest.mark.parametrize("shape", [(1111,), (5, 7), (1,)])
@torch.no_grad()
def test_the_kernel_gives_the_attributes_of_plain_pytorch(channels, hidden, shape):
    headers = networks(channels, hidden)
    x = torch.randn(*shape, channels, generator=torch.Generator().manual_seed(0))
    for found, header in zip(cpu.attributes(headers, x), headers, strict=True):
        expected = header.double()(x.double())
        header.float()
        assert found.shape == expected.shape
        torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_the_number_of_threads_and_other_rows_change_no_bit():
    headers, x = networks(16, (32, 16)), torch.randn(3000, 16)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = cpu.attributes(headers, x)
        torch.set_num_threads(3)
        three = cpu.attributes(headers, x)
    finally:
        torch.set_num_threads(threads)
    part = cpu.attributes(headers, x[1000:1010])
    for mine, others, few in zip(one, three, part, strict=True):
        assert torch.equal(mine, others)
        assert torch.equal(mine[1000:1010], few)


def test_a_head_uses_the_kernel_without_a_gradient(monkeypatch):
    head, calls, fused = shake(make_head()), [], cpu.attributes
    monkeypatch.setattr("ghgs_lit.kernels.pool.features", lambda: {"avx2", "fma"})
    monkeypatch.setattr(cpu, "attributes", lambda *args: calls.append(1) or fused(*args))
    x = torch.randn(10, 32)
    expected = head._raw(x)
    assert not calls
    with torch.no_grad():
        found = head._raw(x)
    assert calls
    for mine, own in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, own)
