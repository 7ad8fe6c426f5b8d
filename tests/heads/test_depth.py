"""Depths: parameterizations, bounds, the dense head around them."""

import pytest
import torch

from ghgs_lit.bounds import NoBounds, SubjectBox, VisualHull
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import project, unproject_maps
from ghgs_lit.geometry.unprojection import Unprojection, subject_tokens
from ghgs_lit.heads.dense import proportioned_dpt
from ghgs_lit.heads.depth import BOUNDED, DepthHead, inverse_linear
from ghgs_lit.types import Batch, Cameras, DepthMaps, Tokens
from tests.helpers.scenes import CASES, fixture, make_batch, ring

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
    return head(make_tokens(batch), batch, (bounds or SubjectBox())(batch))


def make_head(**options):
    torch.manual_seed(1)
    return DepthHead(64, dpt={"features": 16, "out_channels": [16, 16, 16, 16]}, **options)


def square_cameras(name, dtype, size):
    """Cameras of a fixture, whose extrinsics are 3 x 4, for a map of ``size``."""
    inputs = fixture(name, "in", dtype)
    extrinsics = torch.zeros(*inputs["extr"].shape[:2], 4, 4, dtype=dtype)
    extrinsics[..., :3, :], extrinsics[..., 3, 3] = inputs["extr"], 1
    return inputs, Cameras(inputs["intr"], extrinsics, size, size)


def release_token_points(inverse, cameras, dtype):
    """Token points of a padded 518 x 518 inverse depth whose cameras belong to the 512 x 512 inside."""
    padded = cameras.cropped(-3, -3, 518, 518)
    depth = inverse_linear(inverse)
    _, views = depth.shape[:2]
    maps = DepthMaps(depth, torch.ones_like(depth, dtype=torch.bool), torch.ones_like(depth))
    batch = Batch(torch.zeros(1, views, 3, 518, 518), maps.valid, padded)
    points = Unprojection("release", 3)(maps, make_tokens(batch), batch).tokens
    assert points.dtype == dtype
    return points.reshape(views, 37, 37, 3)


def assert_points(found, expected):
    """The bound for points: relative to the norm of each point."""
    error = (found.double() - expected).norm(dim=-1)
    limit = 2e-5 if found.dtype == torch.float32 else 1e-9
    assert (error <= limit * expected.norm(dim=-1)).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pixel_points_match_the_release(dtype):
    inputs, cameras = square_cameras("depth2pts", dtype, 40)
    points = unproject_maps(inverse_linear(inputs["inv_depth"]), cameras)[0]
    assert_points(points, fixture("depth2pts", "out64", torch.float64)["points"])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_token_points_match_the_release(dtype):
    inputs, cameras = square_cameras("depth2pts_token", dtype, 512)
    inverse = inputs["inv_depth"].repeat_interleave(14, -1).repeat_interleave(14, -2)
    points = release_token_points(inverse, cameras, dtype)
    assert_points(points, fixture("depth2pts_token", "out64", torch.float64)["points"])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_token_depth_matches_the_release(dtype):
    inputs, cameras = square_cameras("token_depth_518", dtype, 512)
    points = release_token_points(inputs["inv_depth_518"], cameras, dtype)
    expected = fixture("token_depth_518", "out64", torch.float64)["token_points"]
    bound = CASES["token_depth_518"]["bounds"]["token_points"] if dtype == torch.float32 else 1e-9
    torch.testing.assert_close(points.double(), expected, atol=bound, rtol=0)


def test_subject_tokens_are_means_over_the_subjects_pixels():
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
    batch = make_batch(1, 2)
    tokens = make_tokens(batch)
    maps = DepthMaps(batch.depths, batch.masks, batch.depths)
    every = Unprojection()(maps, tokens, batch)
    keep = torch.arange(0, len(tokens.image), 3)
    assert torch.equal(Unprojection()(maps, tokens.select(keep), batch).tokens, every.tokens[keep])


@pytest.mark.parametrize("name", list(BOUNDED))
def test_parameterizations_stay_in_bounds_and_keep_their_gradient(name):
    near, far = torch.tensor([0.1, 1.5, 2.0])[:, None], torch.tensor([100.0, 2.5, 2.02])[:, None]
    raw = torch.linspace(-200, 200, 41).requires_grad_()
    depth = BOUNDED[name](raw.sigmoid(), near, far)
    assert ((depth >= near * (1 - 1e-6)) & (depth <= far * (1 + 1e-6))).all()
    assert (depth.diff(dim=1) >= 0).all()
    middle = BOUNDED[name](torch.tensor(0.5), near, far)
    expected = {
        "bounded_inverse": 2 / (1 / near + 1 / far),
        "log": (near * far).sqrt(),
        "linear": (near + far) / 2,
    }
    torch.testing.assert_close(middle, expected[name])
    depth.sum().backward()
    assert raw.grad.isfinite().all()
    assert raw.grad[20] > 0.04


@pytest.mark.parametrize("bounds", [SubjectBox(), VisualHull()])
@pytest.mark.parametrize("name", list(BOUNDED))
def test_head_starts_at_a_fraction_of_its_bounds(name, bounds):
    batch = make_batch(2, 3)
    maps = predict(make_head(parameterization=name, start=0.4), batch, bounds)
    torch.testing.assert_close(
        maps.depth, BOUNDED[name](torch.tensor(0.4), maps.bounds.near, maps.bounds.far)
    )
    assert torch.equal(maps.valid, batch.masks)
    assert (maps.confidence >= 1).all()
    assert (maps.depth - batch.depths)[batch.masks].abs().mean() < 0.3


def test_depth_is_wide_under_autocast():
    batch = make_batch()
    head, tokens, bounds = make_head(), make_tokens(batch), VisualHull()(batch)
    torch.nn.init.normal_(head.dpt.scratch.output_conv2[-1].weight)
    expected = head(tokens, batch, bounds)
    with torch.autocast("cpu", torch.bfloat16):
        found = head(tokens, batch, bounds)
        points = Unprojection()(expected, tokens, batch)
    assert found.depth.dtype == found.bounds.near.dtype == points.pixels.dtype == torch.float32
    assert torch.equal(found.bounds.near, expected.bounds.near)
    assert torch.equal(points.tokens, Unprojection()(expected, tokens, batch).tokens)
    assert (found.depth - expected.depth).abs().max() < 0.05


def test_values_that_are_not_finite_are_invalid_and_finite():
    batch = make_batch()
    head = make_head()
    with torch.no_grad():
        head.dpt.scratch.output_conv2[-1].bias.fill_(float("nan"))
    maps = predict(head, batch)
    assert maps.depth.isfinite().all()
    assert not maps.valid.any()


def test_the_releases_parameterization_has_either_sign_and_no_bounds():
    batch = make_batch()
    maps = predict(make_head(parameterization="inverse_linear"), batch, NoBounds())
    assert maps.bounds is None
    values = torch.tensor([0.5, -0.5, 0.0])
    torch.testing.assert_close(inverse_linear(values), torch.tensor([2.0, -2.0, 1e8]))


def test_widths_follow_the_published_ones():
    head = proportioned_dpt(2048, 2)
    shapes = [tuple(p.weight.shape[:2]) for p in head.projects]
    assert shapes == [(256, 2048), (512, 2048), (1024, 2048), (1024, 2048)]
    assert head.scratch.output_conv1.weight.shape[:2] == (128, 256)


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"parameterization": "linar"}, "depth_head.parameterization: expected one of bounded_inverse"),
        ({"views": "some"}, "depth_head.views"),
        ({"start": 1.0}, "depth_head.start"),
    ],
)
def test_impossible_options_are_refused(options, key):
    with pytest.raises(InputError, match=key):
        make_head(**options)


def test_impossible_token_points_are_refused():
    with pytest.raises(InputError, match=r"unprojection\.tokens"):
        Unprojection("center")


def test_ring_cameras_look_at_the_subject():
    cameras = ring(1, 4, 56, 56)
    assert torch.linalg.det(cameras.extrinsics[..., :3, :3]).allclose(torch.ones(1, 4))
