"""World points of tokens: on the subject, and as in the authors' code."""

import pytest
import torch

from ghgs_lit.geometry.projection import project
from ghgs_lit.geometry.unprojection import Unprojection, subject_tokens
from ghgs_lit.method.heads.depth import inverse_linear
from ghgs_lit.types import Batch, DepthMaps
from tests.helpers.scenes import CASES, fixture, make_batch
from tests.method.heads.test_depth import PATCH, assert_points, make_tokens, square_cameras


def release_token_points(inverse, cameras, dtype):
    """Token points of a padded 518 x 518 inverse depth whose cameras are those of the inner 512 x 512."""
    padded = cameras.crop(-3, -3, 518, 518)
    depth = inverse_linear(inverse)
    _, views = depth.shape[:2]
    maps = DepthMaps(depth, torch.ones_like(depth, dtype=torch.bool), torch.ones_like(depth))
    batch = Batch(torch.zeros(1, views, 3, 518, 518), maps.valid, padded)
    points = Unprojection(tokens="release")(maps, make_tokens(batch), batch).tokens
    assert points.dtype == dtype
    return points.reshape(views, 37, 37, 3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_token_points_match_the_release(dtype):
    """World points of tokens equal those of the authors' code."""
    inputs, cameras = square_cameras("depth2pts_token", dtype, 512)
    inverse = inputs["inv_depth"].repeat_interleave(14, -1).repeat_interleave(14, -2)
    points = release_token_points(inverse, cameras, dtype)
    assert_points(points, fixture("depth2pts_token", "out64", torch.float64)["points"])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_token_depth_matches_the_release(dtype):
    """Sampled depths of tokens equal those of the authors' code."""
    inputs, cameras = square_cameras("token_depth_518", dtype, 512)
    points = release_token_points(inputs["inv_depth_518"], cameras, dtype)
    expected = fixture("token_depth_518", "out64", torch.float64)["token_points"]
    bound = CASES["token_depth_518"]["bounds"]["token_points"] if dtype == torch.float32 else 1e-9
    torch.testing.assert_close(points.double(), expected, atol=bound, rtol=0)


def test_subject_tokens_are_means_over_the_subjects_pixels():
    """A token's position and depth do not mix in the background."""
    batch = make_batch(2, 3, 56, 42)
    depth = torch.rand(batch.masks.shape, generator=torch.Generator().manual_seed(0)) + 1
    pixels, means, valid = subject_tokens(DepthMaps(depth, batch.masks, depth), PATCH)
    for index in torch.cartesian_prod(*map(torch.arange, valid.shape)).tolist():
        b, v, i, j = index
        rows, columns = slice(PATCH * i, PATCH * i + PATCH), slice(PATCH * j, PATCH * j + PATCH)
        mask = batch.masks[b, v, rows, columns]
        assert valid[b, v, i, j] == mask.any()
        chosen = mask if mask.any() else torch.ones_like(mask)
        at = chosen.nonzero().float().mean(0).flip(0) + 0.5 + torch.tensor([PATCH * j, PATCH * i])
        torch.testing.assert_close(pixels[b, v, i, j], at, atol=1e-4, rtol=0)
        torch.testing.assert_close(means[b, v, i, j], depth[b, v, rows, columns][chosen].mean())


def test_token_points_lie_on_the_subject_and_project_back():
    """A token's point projects into its own patch."""
    batch = make_batch(1, 3, 112, 112)
    tokens = make_tokens(batch)
    points = Unprojection()(DepthMaps(batch.depths, batch.masks, batch.depths), tokens, batch)
    assert points.tokens_valid.sum() < len(points.tokens) / 2
    kept = points.tokens_valid
    cameras = batch.cameras[0]
    pixel, depth = project(
        points.tokens[kept], cameras.intrinsics[tokens.image[kept]], cameras.extrinsics[tokens.image[kept]]
    )
    cell = torch.stack((tokens.column, tokens.row), -1)[kept]
    assert torch.equal((pixel / PATCH).floor().long(), cell)
    assert ((depth > 1.5) & (depth < 2.5)).all()


def test_unprojection_of_kept_tokens_only():
    """Points of packed tokens equal those of the same tokens in the full set."""
    batch = make_batch(1, 2)
    tokens = make_tokens(batch)
    maps = DepthMaps(batch.depths, batch.masks, batch.depths)
    every = Unprojection()(maps, tokens, batch)
    keep = torch.arange(0, len(tokens.image), 3)
    assert torch.equal(Unprojection()(maps, tokens.select(keep), batch).tokens, every.tokens[keep])
