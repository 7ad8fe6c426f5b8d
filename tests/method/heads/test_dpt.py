"""Properties of the dense head."""

import dataclasses

import pytest
import torch
from torch import nn

from ghgs_lit.errors import InputError
from ghgs_lit.method.heads.dpt import DPTHead, ResidualUnit, add_positions_
from ghgs_lit.types import Tokens


def _tokens(b=1, v=2, h=3, w=2, patch_size=14, width=16, dtype=torch.float32, seed=0) -> Tokens:
    g = torch.Generator().manual_seed(seed)
    image, row, column = (
        axis.flatten() for axis in torch.meshgrid(*map(torch.arange, (b * v, h, w)), indexing="ij")
    )
    latent = tuple(torch.randn(len(image), width, generator=g, dtype=dtype) for _ in range(4))
    return Tokens(latent, latent[0], image, row, column, (b, v, h, w), patch_size)


def _head(seed=0, features=8, out_channels=(4, 8, 8, 12), **options) -> DPTHead:
    torch.manual_seed(seed)
    return DPTHead(16, 3, widths=(features, out_channels), **options)


@pytest.mark.parametrize("patch_size", [7, 8, 10, 14])
@pytest.mark.parametrize("grid", [(1, 1), (3, 2), (2, 5)])
def test_any_patch_size_and_grid(patch_size, grid):
    """The head supports encoders of other patch sizes."""
    tokens = _tokens(2, 2, *grid, patch_size=patch_size)
    raw = _head()(tokens)
    assert raw.shape == (4, 3, patch_size * grid[0], patch_size * grid[1])
    assert raw.isfinite().all()


def test_tokens_that_were_not_kept_are_blank():
    """Missing tokens are 0, not the bias of a projection."""
    head = _head()
    tokens = _tokens(h=4, w=4)
    kept = torch.ones(32, dtype=torch.bool)
    kept[[3, 17]] = False
    seen = []
    hook = nn.Module()
    hook.forward = lambda maps: seen.append(maps.clone()) or maps
    head.resize_layers[2] = hook
    for given in (tokens, tokens.select(kept)):
        assert head(given).isfinite().all()
    # Remove the position embeddings, which are those added to a map of zeros.
    positions = add_positions_(torch.zeros_like(seen[0]), 1.0)
    full, fewer = ((maps - positions).permute(0, 2, 3, 1).reshape(32, -1) for maps in seen)
    assert torch.equal((fewer.abs() < 1e-6).all(1), ~kept)
    torch.testing.assert_close(fewer[kept], full[kept])


@pytest.mark.parametrize("rectified", [True, False])
def test_residual_unit_rectifies_its_skip(rectified):
    """Published weights expect a rectified skip, and the input is not overwritten."""
    block = ResidualUnit(8, rectified)
    nn.init.zeros_(block.conv2.weight)
    nn.init.zeros_(block.conv2.bias)
    x = torch.randn(1, 8, 3, 3)
    kept = x.clone()
    torch.testing.assert_close(block(x), x.clamp(min=0) if rectified else x)
    assert torch.equal(x, kept)


@pytest.mark.parametrize("rectified", [True, False])
def test_what_a_rectified_skip_lets_die_lives_without(rectified):
    """Where a sum of levels is negative, tokens still affect the result and get gradients."""
    head = _head(rectified_skip=rectified)
    for level in (1, 2, 3):
        nn.init.constant_(getattr(head.scratch, f"refinenet{level + 1}").out_conv.bias, -100.0)
    tokens = _tokens(b=1, v=1, h=2, w=3)
    layers = [layer.requires_grad_() for layer in tokens.latent]
    head(tokens).square().sum().backward()
    assert all(layer.grad.any() == (not rectified) for layer in layers)


def test_a_guide_keeps_images_apart_and_is_local():
    """A guide affects its own image, near its pixel, and adds parameters only if it is used."""
    head = _head(guide_channels=4)
    tokens = _tokens(b=1, v=2, h=2, w=3)
    guide = torch.rand(2, 3, 28, 42), torch.rand(2, 1, 28, 42)
    raw = head(tokens, guide)
    moved = tuple(part.clone() for part in guide)
    moved[1][1, :, 4, 6] += 1
    changed = (head(tokens, moved) - raw).abs().amax(1) > 0
    assert not changed[0].any()
    assert changed[1, 2:7, 4:9].any()
    raw.sum().backward()
    assert all(p.grad is not None for p in head.parameters())
    assert not any("guide" in key for key in _head().state_dict())


def test_float16_overflows_no_dense_head():
    """Regression: maps of a head with large weights exceed 65 504, and float16 lost every depth."""
    head, tokens = _head(features=32), _tokens(v=2, h=5, w=5)
    with torch.no_grad():
        for name, parameter in head.named_parameters():
            if not name.startswith("norm"):
                parameter.mul_(10)
        exact = head(tokens)
        half = dataclasses.replace(tokens, latent=tuple(layer.half() for layer in tokens.latent))
        with torch.autocast("cpu", torch.float16):
            low = head(half)
    assert low.dtype == torch.float32
    assert exact.abs().max() > 65504
    assert (low - exact).abs().max() < 0.01 * exact.abs().max()


@pytest.mark.parametrize("grid", [(1, 1), (3, 1), (2, 2)])
def test_gradients_under_autocast_hold_no_memory_that_was_not_written(grid):
    """PyTorch's stride of 2 leaves parts of a gradient unset for maps one cell wide: NaN from freed
    memory."""
    head, tokens = _head(out_channels=(4, 8, 8, 32)), _tokens(3, 2, *grid)
    parameters = list(head.parameters())
    for _ in range(10):
        dirty = [torch.full((count,), torch.nan, dtype=dtype) for count in (4608, 9216, 18432)
                 for dtype in (torch.float32, torch.bfloat16)]  # fmt: skip
        del dirty
        with torch.autocast("cpu", torch.bfloat16):
            raw = head(tokens)
        slopes = torch.autograd.grad(raw.square().sum(), parameters, allow_unused=True)
        assert all(slope.isfinite().all() for slope in slopes if slope is not None)


def test_gradients_reach_every_layer_and_agree_with_finite_differences():
    """In-place operations do not corrupt gradients."""
    head = _head().double()
    tokens = _tokens(v=1, h=2, w=2, patch_size=8, dtype=torch.float64)

    def forward(*latent):
        return head(dataclasses.replace(tokens, latent=latent))

    latent = tuple(x.requires_grad_() for x in tokens.latent)
    assert torch.autograd.gradcheck(forward, latent, fast_mode=True)
    forward(*latent).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in head.parameters())


def test_positions_made_for_inference_serve_training():
    """Cached waves must not be inference tensors, which training rejects."""
    head = _head()
    tokens = _tokens(h=5, w=7)
    with torch.inference_mode():
        expected = head(tokens).clone()
    found = head(tokens)
    torch.testing.assert_close(found, expected)
    found.sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in head.parameters())


def test_wrong_number_of_layers_is_refused():
    """An encoder with another number of layers is rejected by name."""
    tokens = _tokens()
    with pytest.raises(InputError, match=r"tokens.latent: expected four layers; found 3"):
        _head()(dataclasses.replace(tokens, latent=tokens.latent[:3]))
