"""Attention meets the requirements of PyTorch's fused kernels on a GPU."""

import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.config import build, compose

attention = F.scaled_dot_product_attention


@pytest.mark.parametrize("autocast", [False, True])
@pytest.mark.parametrize("tokens", ["all", "subject"])
def test_attention_is_asked_for_what_fused_kernels_take(tokens, autocast, monkeypatch):
    """Requirements of fused GPU kernels: one dtype, channels innermost, heads of whole vectors, no mask.

    Views of equal length share a call, others have one each, and none is padded.
    """
    calls = []

    def attend(q, k, v, *mask, **options):
        calls.append((q, k, v, mask, options))
        return attention(q, k, v)

    monkeypatch.setattr(F, "scaled_dot_product_attention", attend)
    encoder = build(compose("train", ["encoder=vggt_nano", "model=paper"])["encoder"], "encoder")
    encoder.tokens = tokens
    images, masks = torch.rand(2, 3, 3, 56, 42), torch.zeros(2, 3, 56, 42, dtype=torch.bool)
    for number, mask in enumerate(masks.flatten(0, 1)):
        mask[20 : 24 + 5 * number, 20:30] = True
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        encoder(images, masks)  # with a gradient, PyTorch's attention is used
    for q, k, v, mask, options in calls:
        assert q.dtype == k.dtype == v.dtype == (torch.bfloat16 if autocast else torch.float32)
        assert q.stride(-1) == k.stride(-1) == v.stride(-1) == 1
        assert all(stride % 8 == 0 for x in (q, k, v) for stride in x.stride()[:-1])
        assert q.shape[-1] % 8 == 0
        assert not mask
        assert not options
    if tokens == "all":
        assert len(calls) == 2 * 4
    else:
        assert sum(q.shape[0] * q.shape[2] for q, *_ in calls) == 2 * 4 * sum(
            encoder.keeps(masks).sum((1, 2, 3)) + 3 * 5
        )


@pytest.mark.parametrize("name", ["vggt_nano", "vggt_small", "vggt_1b"])
def test_head_widths_fit_fused_kernels(name):
    """Fused kernels require multiples of 8."""
    node = compose("train", [f"encoder={name}"])["encoder"]
    assert node["width"] // node["heads"] % 8 == 0
