"""Properties of the encoder beyond reference numbers."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from omegaconf import OmegaConf

from ghgs_lit.errors import InputError
from ghgs_lit.method.encoder import VGGTEncoder
from ghgs_lit.method.encoder.block import rotary_tables
from ghgs_lit.method.encoder.vit import ConvStem
from ghgs_lit.method.plan.patches import KeptPatches
from tests.helpers.configs import composed
from tests.helpers.encoders import make_encoder

CONF = Path(__file__).parents[3] / "conf"
SMALL = {"width": 32, "heads": 2, "depth": 2, "layers": (0, 1), "vit": {"kind": "stem", "channels": 8}}


def _encoder(seed: int = 0, **options) -> VGGTEncoder:
    """A small encoder whose special tokens and LayerScales are large enough to matter."""
    torch.manual_seed(seed)
    encoder = make_encoder(**{**SMALL, **options})
    with torch.no_grad():
        for name, parameter in encoder.named_parameters():
            if "gamma" in name or "token" in name:
                parameter.normal_()
    return encoder


def _views(b: int, v: int, height: int, width: int, seed: int = 1):
    g = torch.Generator().manual_seed(seed)
    masks = torch.rand(b, v, height, width, generator=g) > 0.5
    return torch.rand(b, v, 3, height, width, generator=g), masks


def _options(name: str) -> dict:
    options = OmegaConf.to_container(composed("train", f"encoder={name}", "model=paper")["encoder"])
    assert options.pop("kind") == "vggt"
    return options


@pytest.mark.parametrize(("name", "most"), [("vggt_nano", 1.2e6), ("vggt_small", 6.5e6)])
def test_small_encoders_fit_their_size(name, most):
    """The small encoders stay small, and every parameter gets a gradient."""
    encoder = make_encoder(**_options(name))
    assert sum(p.numel() for p in encoder.parameters()) < most
    assert len(encoder.aggregator.layers) == 4
    tokens = encoder(*_views(1, 2, 28, 42))
    assert all(latent.shape == (2 * 2 * 3, encoder.dim_latent) for latent in tokens.latent)
    assert not tokens.semantic.requires_grad  # features weight the attention, and are not trained by it
    torch.autograd.backward(tokens.latent, [torch.ones_like(x) for x in tokens.latent])
    assert all(p.grad is not None and p.grad.isfinite().all() for p in encoder.parameters())


def test_every_shipped_size_builds():
    """Every file of conf/encoder is a valid encoder."""
    names = sorted(path.stem for path in (CONF / "encoder").glob("*.yaml"))
    assert names == ["vggt_1b", "vggt_nano", "vggt_small"]
    with torch.device("meta"):
        for name in names:
            make_encoder(**_options(name))


@pytest.mark.parametrize("patch_size", [7, 8, 10, 14])
@pytest.mark.parametrize("mask_input", [False, True])
def test_any_patch_size_and_shape(patch_size, mask_input):
    """Tokens are complete and in order, and depend on the mask only with mask_input."""
    encoder = _encoder(patch_size=patch_size, mask_input=mask_input)
    images, masks = _views(2, 3, 2 * patch_size, 3 * patch_size)
    tokens = encoder(images, masks)
    assert tokens.grid == (2, 3, 2, 3)
    assert tokens.is_dense
    assert tokens.patch_size == patch_size
    order = (tokens.image * 2 + tokens.row) * 3 + tokens.column
    assert torch.equal(order, torch.arange(2 * 3 * 2 * 3))
    seen = encoder(images, ~masks).latent[0]
    assert torch.equal(seen, tokens.latent[0]) is not mask_input


def test_images_that_are_wider_than_the_weights_are_named():
    """Otherwise the error would come from a convolution of a head."""
    images, masks = _views(1, 2, 28, 28)
    with pytest.raises(InputError, match=r"images: expected float32 .*; found torch\.float64"):
        _encoder()(images.double(), masks)


def test_angles_are_float32_whatever_the_tokens():
    """Angles in half precision would shift positions."""
    kept = KeptPatches(torch.ones(1, 1, 37, 37, dtype=torch.bool), torch.device("cpu"))
    positions = kept.positions(special=5)
    exact = rotary_tables(positions, 64, torch.zeros(1))
    for dtype in (torch.bfloat16, torch.float16):
        tables = rotary_tables(positions, 64, torch.zeros(1, dtype=dtype))
        assert tables.cosine.dtype == torch.float32
        assert torch.equal(tables.cosine, exact.cosine)
        assert torch.equal(tables.sine, exact.sine)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(rotary_tables(positions, 64, torch.zeros(1)).sine, exact.sine)


@pytest.mark.parametrize(
    "vit", [SMALL["vit"], {"kind": "dinov2", "depth": 1, "heads": 2}], ids=["stem", "dinov2"]
)
def test_special_tokens_are_drawn_near_zero(vit):
    """As published; the semantic branch's token has the spread of its blocks' weights."""
    semantic = {"width": 32, "depth": 1, "heads": 2, "channels": 8}
    torch.manual_seed(0)
    encoder = make_encoder(**{**SMALL, "vit": vit, "semantic": semantic})
    tokens = {
        name: p for name, p in encoder.named_parameters() if "token" in name and "mask_token" not in name
    }
    assert len(tokens) == (5 if vit["kind"] == "dinov2" else 3)
    for name, token in tokens.items():
        std = 0.02 if "semantic" in name else 1e-6
        assert 0.5 * std < token.std() < 1.5 * std, name


def test_normalisation_is_no_part_of_a_checkpoint():
    """Published weights have no such tensors."""
    assert all(key.startswith("aggregator.") for key in _encoder().state_dict())


@pytest.mark.parametrize("autocast", [False, True])
@pytest.mark.parametrize("tokens", ["all", "subject"])
def test_attention_is_asked_for_what_fused_kernels_take(tokens, autocast, monkeypatch):
    """Requirements of fused GPU kernels: one dtype, channels innermost, heads of whole vectors, no mask.

    Views of equal length share a call, others have one each, and none is padded.
    """
    calls, attention = [], F.scaled_dot_product_attention

    def attend(q, k, v, *mask, **options):
        calls.append((q, k, v, mask, options))
        return attention(q, k, v)

    monkeypatch.setattr(F, "scaled_dot_product_attention", attend)
    encoder = make_encoder(**_options("vggt_nano"), tokens=tokens)
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


GRID = (2, 2, 9, 11)


def kept(*places: tuple[int, int, int, int]) -> KeptPatches:
    found = torch.zeros(GRID, dtype=torch.bool)
    for place in places:
        found[place] = True
    return KeptPatches(found, torch.device("cpu"))


@pytest.mark.parametrize("patch_size", [7, 14, 16, 28])
@pytest.mark.parametrize(
    "places", [[(0, 0, 4, 5)], [(0, 0, 3, 4), (1, 1, 5, 2)], [(0, 1, 0, 10), (1, 0, 8, 0)]]
)
def test_kept_patches_have_the_tokens_of_whole_images(patch_size, places):
    stem = ConvStem(5, 16, patch_size, 8).double()
    images = torch.randn(4, 5, 9 * patch_size, 11 * patch_size, dtype=torch.double)
    everything = KeptPatches(torch.ones(GRID, dtype=torch.bool), images.device)
    some = kept(*places)
    torch.testing.assert_close(stem(images, some), stem(images, everything)[some.index])


def test_what_kept_patches_do_not_depend_on_is_not_seen():
    """NaN in other patches would reach every token through a sum."""
    stem, some = ConvStem(5, 16, 14, 8), kept((0, 0, 4, 5))
    images = torch.full((4, 5, 126, 154), torch.nan)
    images[..., 2 * 14 : 7 * 14, 3 * 14 : 8 * 14] = 0.5
    assert stem(images, some).isfinite().all()


def test_no_kept_patch():
    assert ConvStem(5, 16, 14, 8)(torch.rand(4, 5, 126, 154), kept()).shape == (0, 16)


def test_the_box_holds_the_kept_patches_of_all_images():
    """The margin is clipped to the grid; without kept patches the box is one patch, through which
    gradients of 0 flow."""
    assert kept((0, 0, 3, 4), (1, 1, 5, 2)).box(1) == (slice(2, 7), slice(1, 6))
    assert kept((0, 1, 0, 10), (1, 0, 8, 9)).box(2) == (slice(0, 9), slice(7, 11))
    assert kept().box(0) == (slice(0, 1), slice(0, 1))
