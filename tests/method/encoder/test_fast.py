"""Patches dropped before the first block, against masked attention in float64."""

import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.geometry.masks import patches_around_subject, patches_in_window
from ghgs_lit.method.encoder import VGGTEncoder
from ghgs_lit.method.encoder.block import rotary_tables, rotate
from ghgs_lit.method.plan import make_plan
from ghgs_lit.method.plan.patches import KeptPatches
from tests.helpers.encoders import make_encoder

PATCH, ROWS, COLUMNS = 14, 5, 7
VITS = [{"kind": "conv"}, {"kind": "stem", "channels": 8}, {"kind": "dinov2", "depth": 2, "heads": 2}]


def _encoder(vit=VITS[0], **options) -> VGGTEncoder:
    """A small encoder in float64 whose special tokens and LayerScales are large enough to matter."""
    torch.manual_seed(0)
    options = {"tokens": "subject", **options}
    encoder = make_encoder(width=32, heads=2, depth=2, layers=(0, 1), vit=vit, image_size=42, **options)
    with torch.no_grad():
        for name, parameter in encoder.named_parameters():
            if "gamma" in name or "token" in name or "pos_embed" in name:
                parameter.normal_()
    return encoder.double()


def _people() -> tuple[torch.Tensor, torch.Tensor]:
    """Images and masks [2, 4, ...]: two people, a single pixel, an empty view, one at the border, and
    more."""
    masks = torch.zeros(2, 4, PATCH * ROWS, PATCH * COLUMNS, dtype=torch.bool)
    masks[0, 0, 10:20, 3:20] = masks[0, 0, 40:50, 80:90] = True  # two people
    masks[0, 1, 31, 44] = True  # a single pixel; view 2 is empty
    masks[0, 3, 20:, 60:] = True  # at the border
    masks[1, 0, 30:40, 30:60] = masks[1, 2, 5:60, 40:50] = masks[1, 3, 0, 0] = True
    masks[1, 1] = True  # a full frame
    generator = torch.Generator().manual_seed(1)
    return torch.rand(2, 4, 3, *masks.shape[2:], generator=generator, dtype=torch.float64), masks


def _kept_slowly(mask: torch.Tensor, margin: int, window: bool = False) -> torch.Tensor:
    """Kept patches, by a loop."""
    touched = torch.tensor(
        [
            [
                bool(mask[PATCH * r : PATCH * (r + 1), PATCH * c : PATCH * (c + 1)].any())
                for c in range(COLUMNS)
            ]
            for r in range(ROWS)
        ]
    )
    if window and touched.any():
        (top, left), (bottom, right) = touched.nonzero().amin(0), touched.nonzero().amax(0)
        touched[top : bottom + 1, left : right + 1] = True
    near = [
        [
            bool(touched[max(0, r - margin) : r + margin + 1, max(0, c - margin) : c + margin + 1].any())
            for c in range(COLUMNS)
        ]
        for r in range(ROWS)
    ]
    return torch.tensor(near)


def _masked_block(block, x, keys, rotary=None):
    """A block on padded sequences [n, t, c] whose attention is restricted to ``keys`` [n, t]."""
    n, t, c = x.shape
    attention = block.attn
    qkv = attention.qkv(block.norm1(x)).view(n, t, 3, attention.heads, -1).permute(2, 0, 3, 1, 4)
    q, k, v = attention.q_norm(qkv[0]), attention.k_norm(qkv[1]), qkv[2]
    if rotary is not None:
        q, k = rotate(q, rotary), rotate(k, rotary)
    scores = (q @ k.mT / q.shape[-1] ** 0.5).masked_fill(~keys[:, None, None], -torch.inf)
    mixed = (scores.softmax(-1) @ v).transpose(1, 2).reshape(n, t, c)
    x = x + block.ls1.gamma * attention.proj(mixed)
    return x + block.ls2.gamma * block.mlp.fc2(F.gelu(block.mlp.fc1(block.norm2(x))))


def _masked_encoder(encoder, images, kept):
    """Latents [V, P, 2 C] of each layer and features [V, P, C] of one element, from all its tokens."""
    aggregator = encoder.aggregator
    v, special = len(images), aggregator.special
    keys = torch.cat((torch.ones(v, special, dtype=torch.bool), kept.flatten(1)), dim=1)
    embed, x = aggregator.patch_embed, (images - encoder.mean) / encoder.std
    if hasattr(embed, "blocks"):
        patches = embed.patch_embed.proj(x).flatten(2).mT
        positions = embed.positions(ROWS, COLUMNS, x.dtype)
        first = torch.cat((embed.cls_token + positions[:, :1], embed.register_tokens), dim=1)
        x = torch.cat((first.expand(v, -1, -1), patches + positions[:, 1:]), dim=1)
        for block in embed.blocks:
            x = _masked_block(block, x, keys)
        patches = embed.norm(x)[:, embed.special :]
    else:
        patches = embed(
            x, KeptPatches(torch.ones(1, v, ROWS, COLUMNS, dtype=torch.bool), x.device)
        ).unflatten(0, (v, -1))
    first = torch.cat((aggregator.camera_token, aggregator.register_token), dim=2)[0]
    x = torch.cat((first[[0] + [1] * (v - 1)], patches), dim=1)
    places = [(0, 0)] * special + [(r, c) for r in range(1, ROWS + 1) for c in range(1, COLUMNS + 1)]
    inside = rotary_tables(torch.tensor(places), 16, x)
    across = rotary_tables(torch.tensor(places * v), 16, x)
    layers = []
    for frame_block, global_block in zip(aggregator.frame_blocks, aggregator.global_blocks, strict=True):
        frame = _masked_block(frame_block, x, keys, inside)
        x = _masked_block(global_block, frame.flatten(0, 1)[None], keys.flatten()[None], across)
        x = x.view_as(frame)
        layers.append(torch.cat((frame, x), dim=-1)[:, special:])
    return layers, patches


def _same(a, b):
    torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("vit", VITS, ids=lambda vit: vit["kind"])
@pytest.mark.parametrize(
    ("tokens", "margin"),
    [("all", 0), ("subject", 0), ("subject", 1), ("subject", 2), ("window", 0), ("window", 3)],
)
@torch.no_grad()
def test_background_is_as_if_no_attention_saw_it(vit, tokens, margin):
    """Kept tokens have their true positions and do not depend on dropped ones. The reference computes
    each element alone, with frame attention per view and the special tokens of a first view."""
    encoder = _encoder(vit, tokens=tokens, margin=margin)
    images, masks = _people()
    seen = torch.ones_like(masks) if tokens == "all" else masks
    kept = torch.stack([_kept_slowly(mask, margin, tokens == "window") for mask in seen.flatten(0, 1)])
    tokens = encoder(images, masks)
    image, row, column = kept.nonzero(as_tuple=True)
    assert torch.equal(tokens.image, image)
    assert torch.equal(tokens.row, row)
    assert torch.equal(tokens.column, column)
    assert tokens.is_dense == bool(kept.all())
    elements = [
        _masked_encoder(encoder, *pair) for pair in zip(images, kept.view(2, 4, ROWS, COLUMNS), strict=True)
    ]
    for layer, latent in enumerate(tokens.latent):
        _same(latent, torch.cat([layers[layer] for layers, _ in elements])[image, row * COLUMNS + column])
    _same(tokens.semantic, torch.cat([patches for _, patches in elements])[image, row * COLUMNS + column])


@torch.no_grad()
def test_kept_patches_that_are_given_take_part():
    """The plan's patches become tokens, not the encoder's own choice."""
    encoder, (images, masks) = _encoder(VITS[2]), _people()
    kept = torch.stack((patches_in_window(masks, PATCH, 0)[0], patches_around_subject(masks, PATCH, 1)[1]))
    found = encoder(images, masks, plan=make_plan(masks, PATCH, kept))
    for b, tokens in enumerate(("window", "subject")):
        own = slice(b, b + 1)
        expected = _encoder(VITS[2], tokens=tokens, margin=b)(images[own], masks[own])
        mine = found.image // 4 == b
        assert torch.equal(found.row[mine], expected.row)
        _same(found.latent[1][mine], expected.latent[1])


@torch.no_grad()
def test_without_a_subject_there_are_no_tokens():
    """Without a subject, the encoder returns no tokens and raises no error."""
    images, masks = _people()
    tokens = _encoder(VITS[2])(images, torch.zeros_like(masks))
    assert tokens.latent[0].shape == (0, 64)
    assert tokens.semantic.shape == (0, 32)
    assert (tokens.maps(1) == 0).all()


@pytest.mark.parametrize("vit", VITS, ids=lambda vit: vit["kind"])
@pytest.mark.parametrize("checkpointing", [False, True])
def test_gradients_are_finite_and_those_of_masked_attention(vit, checkpointing):
    """Training with few tokens trains every parameter."""
    encoder = _encoder(vit, checkpointing=checkpointing)
    images, masks = _people()
    sum(layer.square().mean() for layer in encoder(images, masks).latent).backward()
    found = {name: p.grad for name, p in encoder.named_parameters() if "mask_token" not in name}
    assert all(grad is not None and grad.isfinite().all() for grad in found.values())
    encoder.zero_grad()
    kept = patches_around_subject(masks, PATCH, 1)
    elements = [_masked_encoder(encoder, *pair)[0] for pair in zip(images, kept, strict=True)]
    sum(
        torch.cat(layers)[kept.view(8, -1)].square().mean() for layers in zip(*elements, strict=True)
    ).backward()
    for name, grad in found.items():
        expected = encoder.get_parameter(name).grad
        # Position embeddings and their gradients are resampled in float32.
        torch.testing.assert_close(grad, expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max()))
