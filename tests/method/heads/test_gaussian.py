"""Gaussians: attributes, their bounds and initial values."""

import dataclasses

import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.geometry.rotations import quaternion_to_matrix
from ghgs_lit.geometry.unprojection import Unprojection
from ghgs_lit.method.heads.gaussian import GaussianHead, GaussianHeadOptions
from ghgs_lit.ops.activation import surface_axes
from ghgs_lit.types import DepthMaps
from tests.helpers.plans import plan_of
from tests.helpers.scenes import CASES, CENTER, RADII, fixture, make_batch
from tests.method.heads.test_depth import make_tokens

HEADERS = ("offset_header", "scale_header", "rot_header", "opacity_header")


def make_head(**options):
    torch.manual_seed(4)
    return GaussianHead(GaussianHeadOptions(**options), 64)


def run(head, batch, masks=None, pixels="subject"):
    maps = DepthMaps(batch.depths, batch.masks if masks is None else masks, batch.depths)
    tokens = make_tokens(batch)
    points = Unprojection()(maps, tokens, batch)
    plan = plan_of(batch.masks, pixels=pixels)
    return head.activate(head(tokens, batch, points, maps, plan), batch, points, maps)


def shake(head, scale=1.0):
    """Perturb the initial weights, as training does."""
    for name in HEADERS:
        torch.nn.init.normal_(getattr(head, name)[-1].weight, std=scale)
    return head


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_attributes_match_the_release(dtype):
    """Attributes of the authors' checkpoints equal those of their code."""
    head = make_head(parameterization="release").to(dtype)
    state = fixture("attribute_heads", "state", dtype)
    missing, unexpected = head.load_state_dict(state, strict=False)
    assert not unexpected
    assert all(key.startswith("decoder.") for key in missing)
    raw = head._raw(fixture("attribute_heads", "in", dtype)["x"][0])
    found = dict(zip(("offset", "scale", "rot", "opacity"), head.attributes(*raw, raw[3]), strict=True))
    expected = fixture("attribute_heads", "out64", torch.float64)
    for name, value in found.items():
        bound = CASES["attribute_heads"]["bounds"][name] if dtype == torch.float32 else 1e-9
        target = expected[name][0].reshape(value.shape)
        torch.testing.assert_close(value.double(), target, atol=bound, rtol=0)


def test_training_starts_with_small_opaque_splats_on_the_surface():
    """Splats that are initially off the surface or transparent get no useful gradient."""
    batch = make_batch(2, 3)
    gaussians = run(make_head(), batch)
    maps = DepthMaps(batch.depths, batch.masks, batch.depths)
    points = Unprojection()(maps, make_tokens(batch), batch)
    assert torch.equal(gaussians.means, points.pixels[batch.masks])
    footprint = batch.depths[batch.masks] / batch.cameras.intrinsics[0, 0, 0, 0]
    torch.testing.assert_close(gaussians.scales, 0.25 * footprint[:, None].expand(-1, 3))
    torch.testing.assert_close(gaussians.opacities, torch.full_like(gaussians.opacities, 0.8))
    assert torch.equal(gaussians.quaternions, torch.tensor([1.0, 0, 0, 0]).expand(len(gaussians), 4))
    assert torch.equal(gaussians.colors, batch.images.permute(0, 1, 3, 4, 2)[batch.masks])


def test_training_starts_with_discs_that_end_at_the_silhouette():
    """With surface axes: flat along the normal, wide along the surface, moved inward."""
    batch = make_batch(1, 3, 112, 112)
    start = {"scale_start": 0.5, "thickness_start": 0.2, "inward": 0.4}
    gaussians = run(make_head(axes="surface", attributes=start), batch)
    footprint = (batch.depths / batch.cameras.intrinsics[..., :1, :1])[batch.masks][:, None]
    expected = footprint * torch.tensor([0.5, 0.5, 0.2])
    torch.testing.assert_close(gaussians.scales, expected, rtol=1e-4, atol=0)
    points = unproject_maps(batch.depths, batch.cameras)[batch.masks]
    moved = gaussians.means - points
    torch.testing.assert_close(moved.norm(dim=-1, keepdim=True), 0.4 * footprint)
    inward = F.normalize((CENTER - points) / RADII.square(), dim=-1)
    assert (F.normalize(moved, dim=-1) * inward).sum(-1).quantile(0.05) > 0.98
    thin = quaternion_to_matrix(gaussians.quaternions)[..., 2]
    assert (thin * inward).sum(-1).quantile(0.05) > 0.98


def test_offsets_and_rotations_are_along_the_axes_of_the_surface():
    """Equal raw values have the same effect for every camera of a ring, whatever the world's axes."""
    batch = make_batch(1, 2, 56, 56, spread=180.0)
    maps = DepthMaps(batch.depths, batch.masks, batch.depths)
    points = Unprojection()(maps, make_tokens(batch), batch)
    head = make_head(axes="surface", attributes={"scale_start": 0.5, "thickness_start": 0.2})
    raw = head(make_tokens(batch), batch, points, maps, plan_of(batch.masks))
    n = len(raw.image)
    some = {"offset": (0.3, -0.2, 0.1), "rotation": (0.0, 0.4, 0.1, -0.2)}
    some = {name: torch.tensor(value).expand(n, -1) for name, value in some.items()}
    gaussians = head.activate(dataclasses.replace(raw, **some), batch, points, maps)
    axes = surface_axes(maps, batch.cameras, raw.image, raw.pixel)
    matrix = quaternion_to_matrix(axes)
    own = (matrix.mT @ (gaussians.means - points.pixels[batch.masks])[..., None])[..., 0]
    torch.testing.assert_close(own, 0.05 * some["offset"].tanh(), atol=1e-6, rtol=1e-4)
    turned = matrix.mT @ quaternion_to_matrix(gaussians.quaternions)
    expected = quaternion_to_matrix(some["rotation"] + torch.tensor([1.0, 0, 0, 0]))
    torch.testing.assert_close(turned, expected, atol=1e-5, rtol=0)


def test_rim_pixels_have_the_subjects_color_and_the_opacity_of_their_share():
    """An image on black is premultiplied by its matte."""
    batch = make_batch(1, 2)
    share = torch.rand(batch.masks.shape, generator=torch.Generator().manual_seed(5)) * batch.masks
    mixed = dataclasses.replace(batch, images=batch.images * share[:, :, None], alpha=share)
    plain, soft = run(make_head(), batch), run(make_head(), mixed)
    torch.testing.assert_close(soft.colors, plain.colors)
    torch.testing.assert_close(soft.opacities, plain.opacities * share[batch.masks])
    assert torch.equal(soft.means, plain.means)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_attributes_stay_within_their_bounds(scale):
    """No raw value gives a giant, transparent or distant splat."""
    batch = make_batch()
    gaussians = run(shake(make_head(), scale), batch)
    start = run(make_head(), batch)
    footprint = start.scales / 0.25
    assert ((gaussians.means - start.means).abs() <= 0.05 + 1e-6).all()
    ratio = gaussians.scales / footprint
    assert ((ratio >= 0.15 * 0.999) & (ratio <= 4 * 1.001)).all()
    assert ((gaussians.opacities >= 0.1) & (gaussians.opacities <= 1)).all()
    torch.testing.assert_close(gaussians.quaternions.norm(dim=-1), torch.ones(len(gaussians)))
    assert ratio.std() > 0.01


def test_scale_does_not_pull_on_the_depth():
    """A splat that is too large must not move nearer to become smaller."""
    batch = make_batch()
    depth = batch.depths.clone().requires_grad_()
    gaussians = run(make_head(), dataclasses.replace(batch, depths=depth))
    assert not torch.autograd.grad(gaussians.scales.sum(), depth, allow_unused=True)[0]


@pytest.mark.parametrize("parameterization", ["footprint", "release"])
def test_no_valid_pixel_gives_no_gaussians(parameterization):
    """A batch without a valid pixel gives an empty result with finite gradients."""
    batch = make_batch(2, 2)
    head = make_head(parameterization=parameterization)
    gaussians = run(head, batch, torch.zeros_like(batch.masks))
    assert len(gaussians) == 0
    assert gaussians.splits == (0, 0)
    (gaussians.means.sum() + gaussians.scales.sum()).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in head.parameters())


def test_the_last_projection_is_wide_under_autocast():
    """Half precision in the last layer would round offsets of millimetres."""
    head = shake(make_head())
    descriptors = torch.rand(50, 32)
    hidden = head.offset_header[:-1]
    with torch.autocast("cpu", torch.bfloat16):
        offset = head._raw(descriptors)[0]
        expected = hidden(descriptors).float()
    last = head.offset_header[-1]
    torch.testing.assert_close(offset, torch.nn.functional.linear(expected, last.weight, last.bias))


def test_footprints_are_of_the_mean_focal_length():
    """For pixels that are not square, the geometric mean of their sides."""
    batch = make_batch()
    lenses = batch.cameras.intrinsics.clone()
    lenses[..., 0, 0] *= 4
    stretched = dataclasses.replace(batch, cameras=dataclasses.replace(batch.cameras, intrinsics=lenses))
    torch.testing.assert_close(run(make_head(), stretched).scales, run(make_head(), batch).scales / 2)
