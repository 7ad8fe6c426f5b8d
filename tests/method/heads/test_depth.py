"""Depths: parameterizations, bounds, and the dense head."""

import pytest
import torch

from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.geometry.unprojection import Unprojection
from ghgs_lit.method.bounds import NoBounds, SubjectBox, VisualHull
from ghgs_lit.method.heads.depth import BOUNDED, DepthHead, DepthHeadOptions, inverse_linear
from ghgs_lit.types import Cameras, Tokens
from tests.helpers.plans import plan_of
from tests.helpers.scenes import fixture, make_batch

PATCH = 14


def make_tokens(batch, dim=64, seed=0):
    b, v, height, width = batch.masks.shape
    grid = (b, v, height // PATCH, width // PATCH)
    axes = (torch.arange(n) for n in (b * v, *grid[2:]))
    image, row, column = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
    generator = torch.Generator().manual_seed(seed)
    latent = tuple(torch.randn(len(image), dim, generator=generator) for _ in range(4))
    semantic = torch.randn(len(image), 24, generator=generator)
    return Tokens(latent, semantic, image, row, column, grid, PATCH)


def predict(head, batch, bounds=None):
    return head(
        make_tokens(batch), batch, (bounds or SubjectBox())(batch), plan_of(batch.masks, pixels="all")
    )


def make_head(**options):
    torch.manual_seed(1)
    return DepthHead(DepthHeadOptions(**options), 64)


def square_cameras(name, dtype, size):
    """Cameras of a fixture, whose extrinsics are 3 x 4, for a map of ``size``."""
    inputs = fixture(name, "in", dtype)
    extrinsics = torch.zeros(*inputs["extr"].shape[:2], 4, 4, dtype=dtype)
    extrinsics[..., :3, :], extrinsics[..., 3, 3] = inputs["extr"], 1
    return inputs, Cameras(inputs["intr"], extrinsics, size, size)


def assert_points(found, expected):
    """Compares points with a bound relative to the norm of each point."""
    error = (found.double() - expected).norm(dim=-1)
    limit = 2e-5 if found.dtype == torch.float32 else 1e-9
    assert (error <= limit * expected.norm(dim=-1)).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pixel_points_match_the_release(dtype):
    """World points of pixels equal those of the authors' code."""
    inputs, cameras = square_cameras("depth2pts", dtype, 40)
    points = unproject_maps(inverse_linear(inputs["inv_depth"]), cameras)[0]
    assert_points(points, fixture("depth2pts", "out64", torch.float64)["points"])


@pytest.mark.parametrize("name", list(BOUNDED))
def test_parameterizations_stay_in_bounds_and_keep_their_gradient(name):
    """No raw value leaves the bounds or loses its gradient."""
    near, far = torch.tensor([0.1, 1.5, 2.0])[:, None], torch.tensor([100.0, 2.5, 2.02])[:, None]
    raw = torch.linspace(-200, 200, 41).requires_grad_()
    depth = BOUNDED[name](raw.sigmoid(), near, far)
    assert ((depth >= near * (1 - 1e-6)) & (depth <= far * (1 + 1e-6))).all()
    assert (depth.diff(dim=1) >= 0).all()
    middle = BOUNDED[name](torch.tensor(0.5), near, far)
    expected = {
        "bounded_inverse": 2 / (1 / near + 1 / far),
        "linear": (near + far) / 2,
    }
    torch.testing.assert_close(middle, expected[name])
    depth.sum().backward()
    assert raw.grad.isfinite().all()
    assert raw.grad[20] > 0.04


@pytest.mark.parametrize("bounds", [SubjectBox(), VisualHull()])
@pytest.mark.parametrize("name", list(BOUNDED))
def test_head_starts_at_a_fraction_of_its_bounds(name, bounds):
    """Initial depths lie inside the bounds, at ``start``."""
    batch = make_batch(2, 3)
    maps = predict(make_head(parameterization=name, start=0.4), batch, bounds)
    torch.testing.assert_close(
        maps.depth, BOUNDED[name](torch.tensor(0.4), maps.bounds.near, maps.bounds.far)
    )
    assert torch.equal(maps.valid, batch.masks)
    assert (maps.confidence >= 1).all()
    assert (maps.depth - batch.depths)[batch.masks].abs().mean() < 0.3


def test_depth_is_wide_under_autocast():
    """Depths in half precision would be off by centimetres."""
    batch = make_batch()
    head, tokens, bounds = make_head(), make_tokens(batch), VisualHull()(batch)
    torch.nn.init.normal_(head.dpt.scratch.output_conv2[-1].weight)
    plan = plan_of(batch.masks, pixels="all")
    expected = head(tokens, batch, bounds, plan)
    with torch.autocast("cpu", torch.bfloat16):
        found = head(tokens, batch, bounds, plan)
        points = Unprojection()(expected, tokens, batch)
    assert found.depth.dtype == found.bounds.near.dtype == points.pixels.dtype == torch.float32
    assert torch.equal(found.bounds.near, expected.bounds.near)
    assert torch.equal(points.tokens, Unprojection()(expected, tokens, batch).tokens)
    assert (found.depth - expected.depth).abs()[batch.masks].max() < 0.005


def test_values_that_are_not_finite_are_invalid_and_finite():
    """A NaN of the network does not spread into the points."""
    batch = make_batch()
    head = make_head()
    with torch.no_grad():
        head.dpt.scratch.output_conv2[-1].bias.fill_(float("nan"))
    maps = predict(head, batch)
    assert maps.depth.isfinite().all()
    assert not maps.valid.any()


def test_the_releases_parameterization_has_either_sign_and_no_bounds():
    """The authors' checkpoints need their own formula."""
    batch = make_batch()
    maps = predict(make_head(parameterization="inverse_linear"), batch, NoBounds())
    assert maps.bounds is None
    values = torch.tensor([0.5, -0.5, 0.0])
    torch.testing.assert_close(inverse_linear(values), torch.tensor([2.0, -2.0, 1e8]))
