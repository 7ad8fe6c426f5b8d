"""The semantic branch: features of single views, independent of the choice of tokens."""

import pytest
import torch

from ghgs_lit.geometry.masks import patches_around_subject
from ghgs_lit.method.encoder import VGGTEncoder
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.training import Optimization
from tests.helpers.encoders import make_encoder

BRANCH = {"width": 16, "depth": 2, "heads": 2, "channels": 8}
SMALL = {"width": 32, "heads": 2, "depth": 1, "layers": (0,), "vit": {"kind": "stem", "channels": 8}}


def make(**options) -> VGGTEncoder:
    """An encoder in float64 whose branch token and LayerScales are large enough to matter."""
    torch.manual_seed(0)
    encoder = make_encoder(**{**SMALL, "semantic": BRANCH, **options}).double()
    with torch.no_grad():
        for name, parameter in encoder.semantic.named_parameters():
            if "gamma" in name or "token" in name:
                parameter.normal_()
    return encoder


def views(b=2, v=3, seed=1):
    """Images of 4 x 5 patches with a different outline of the subject in each."""
    g = torch.Generator().manual_seed(seed)
    masks = torch.zeros(b, v, 56, 70, dtype=torch.bool)
    for n, mask in enumerate(masks.flatten(0, 1)):
        mask[10 : 30 + 4 * n, 20 : 40 + 2 * n] = True
    return torch.rand(b, v, 3, 56, 70, generator=g, dtype=torch.float64), masks


def of_subject(encoder, images, masks, **choice):
    """Semantic features of the subject's patches for a choice of tokens."""
    for name, value in choice.items():
        setattr(encoder, name, value)
    tokens = encoder(images, masks)
    shown = patches_around_subject(masks, 14, 0).flatten(0, 1)[tokens.image, tokens.row, tokens.column]
    return tokens.semantic[shown]


@pytest.mark.parametrize(("tokens", "margin"), [("window", 0), ("window", 2), ("subject", 0), ("subject", 1)])
def test_no_choice_of_tokens_changes_a_feature(tokens, margin):
    """A preset of skip that changed the features would change the attention."""
    encoder, (images, masks) = make(), views()
    expected = of_subject(encoder, images, masks)
    found = of_subject(encoder, images, masks, tokens=tokens, margin=margin)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_a_feature_depends_on_its_own_photograph_and_mask_alone():
    """Other views and batch mates have no influence; the far end of the image and the mask do."""
    encoder, (images, masks) = make(), views()
    together = of_subject(encoder, images, masks)
    alone = torch.cat(
        [
            of_subject(encoder, images[b, v][None, None], masks[b, v][None, None])
            for b in (0, 1)
            for v in range(3)
        ]
    )
    torch.testing.assert_close(alone, together, rtol=1e-9, atol=1e-9)
    changed = images.clone()
    changed[0, 0, :, 10:14] += 0.5  # the top row of patches of the first view
    difference = (of_subject(encoder, changed, masks) - together).abs().amax(1)
    count = int(patches_around_subject(masks, 14, 0)[0, 0].sum())
    assert (difference[:count] > 1e-6).all()
    assert difference[count:].max() < 1e-9
    other = masks.clone()
    other[0, 0, 29] = False
    assert (of_subject(encoder, images, other)[:count] - together[:count]).abs().max() > 1e-3


def test_where_there_is_no_subject_features_are_zero():
    """Background is consistent with nothing, and a view without a subject is not an error."""
    encoder, (images, masks) = make(), views()
    masks[0, 1] = False
    semantic = encoder(images, masks).semantic.unflatten(0, (2, 3, 4, 5))
    shown = patches_around_subject(masks, 14, 0)
    assert torch.equal(semantic.abs().sum(-1) > 0, shown)
    assert not semantic[0, 1].any()
    encoder.tokens = "subject"
    assert encoder(images, torch.zeros_like(masks)).semantic.shape == (0, 16)


def test_the_consistency_of_two_patches_is_the_overlap_of_their_parts():
    """The cosine that weights the attention (Eq. 4) is 1 for equal shares and 0 for disjoint ones."""
    encoder, (images, masks) = make(), views()
    with torch.no_grad():
        encoder.semantic.head.weight.mul_(5)
    features = of_subject(encoder, images, masks)
    kept = KeptPatches(encoder.semantic.subject(masks), images.device)
    shares = encoder.semantic.log_shares(images, masks, kept).exp()
    torch.testing.assert_close(shares.sum(1), torch.ones(len(shares), dtype=torch.float64))
    cosines = torch.nn.functional.cosine_similarity(features[:, None], features[None], dim=-1)
    torch.testing.assert_close(cosines, (shares[:, None] * shares[None]).sqrt().sum(-1))
    assert cosines.min() < 0.9


def test_the_branch_does_not_learn_and_the_rest_does():
    """If features were trained with the rendering loss, they would no longer represent parts."""
    encoder, (images, masks) = make(), views()
    tokens = encoder(images, masks)
    assert not tokens.semantic.requires_grad
    tokens.latent[0].square().sum().backward()
    for name, parameter in encoder.named_parameters():
        assert (parameter.grad is None) == name.startswith("semantic."), name
    trained = Optimization(lr=1e-3).optimizer(encoder).param_groups[0]["params"]
    assert {id(p) for p in trained} == {id(p) for n, p in encoder.named_parameters() if "semantic." not in n}
    assert encoder.dim_semantic == 16


def test_half_precision_weights_run():
    """Features are float32 for weights of any dtype, so the shares of a patch add up to 1."""
    encoder, (images, masks) = make(), views()
    full = of_subject(encoder, images, masks)
    half = of_subject(encoder.bfloat16(), images.float(), masks)
    assert half.dtype == torch.float32
    torch.testing.assert_close(half.square().sum(1), torch.ones(len(half)))
    torch.testing.assert_close(half.double(), full, rtol=0, atol=0.1)
