"""Coarse to fine: which views are downsampled, and how the resulting depths initialise the rounds."""

import dataclasses

import pytest
import torch

from ghgs_lit.geometry.padding import pad_to_patches
from ghgs_lit.geometry.projection import project, unproject_maps
from ghgs_lit.method.model import resolve_height
from ghgs_lit.method.rounds.coarse import (
    CoarseDepths,
    coarse_sizes,
    enlarge,
    shrink,
    spread_tokens,
)
from ghgs_lit.types import DepthBounds, DepthMaps, Tokens
from tests.helpers.models import close, make_model, predict
from tests.helpers.scenes import in_dtype, make_batch, with_soft_rims

#: of images that are too large for weights trained for a subject of ``HEIGHT`` pixels
SIDE = 112
HEIGHT = 40


def recurrent(height, *overrides):
    """A model trained for subjects of ``height`` pixels, with rounds that change something."""
    small = ("rounds.hidden=16", "rounds.depths=4", f"rounds.height={height}")
    model = make_model("model=recurrent", "skip=exact", *small, *overrides).eval()
    torch.nn.init.normal_(model.rounds.change[-1].weight, std=0.5)
    torch.nn.init.normal_(model.rounds.exchange.hear.weight, std=0.5)
    return model


def stack_batches(*batches):
    """The elements of several batches in one, without depths."""
    matrices = {
        name: torch.cat([getattr(batch.cameras, name) for batch in batches])
        for name in ("intrinsics", "extrinsics")
    }
    parts = {name: torch.cat([getattr(batch, name) for batch in batches]) for name in ("images", "masks")}
    cameras = dataclasses.replace(batches[0].cameras, **matrices)
    return dataclasses.replace(batches[0], **parts, cameras=cameras, depths=None)


def test_the_height_of_each_subject_decides():
    """Its tallest or widest view in pixels decides; sides of copies are whole patches."""
    tall, small = make_batch(1, 3, SIDE, SIDE), make_batch(1, 3, SIDE, SIDE, zoom=0.3)
    pair = stack_batches(tall, small)
    rows = tall.masks[0].any(-1).sum(-1).max().item()
    expected = round(SIDE * HEIGHT / rows / 14) * 14
    assert coarse_sizes(pair, HEIGHT, 14) == [(expected, expected), None]
    assert coarse_sizes(pair, rows, 14) == [None, None]
    cut = tall.masks.clone()
    cut[:, 0, SIDE // 2 :] = False  # the tallest view decides
    assert coarse_sizes(dataclasses.replace(tall, masks=cut), HEIGHT, 14) == [(expected, expected)]
    lying = dataclasses.replace(tall, masks=tall.masks.mT)
    assert coarse_sizes(lying, HEIGHT, 14) == [(expected, expected)]
    nobody = dataclasses.replace(tall, masks=torch.zeros_like(tall.masks))
    assert coarse_sizes(nobody, HEIGHT, 14) == [None]


def test_smaller_copies_show_the_same_scene():
    """Surface points keep their position in the image, and colours and mattes stay in place."""
    batch = with_soft_rims(make_batch(1, 3, 112, 84))
    batch = dataclasses.replace(batch, images=batch.alpha[:, :, None].expand(-1, -1, 3, -1, -1) / 2)
    found = shrink(batch, (56, 42), 0.125)
    assert found.masks.shape[2:] == (found.cameras.height, found.cameras.width) == (56, 42)
    points = unproject_maps(batch.depths, batch.cameras).flatten(2, 3)
    pixels = [
        project(points, c.intrinsics[:, :, None], c.extrinsics[:, :, None])[0]
        for c in (batch.cameras, found.cameras)
    ]
    torch.testing.assert_close(pixels[1], pixels[0] / 2)
    torch.testing.assert_close(found.images[:, :, 0], found.alpha / 2)
    assert torch.equal(found.masks, found.alpha > 0.125)
    # Mattes are means over areas, so their sum is preserved.
    torch.testing.assert_close(4 * found.alpha.sum((2, 3)), batch.alpha.sum((2, 3)), rtol=1e-3, atol=0)


def test_enlarged_depths_lie_on_planes_up_to_a_pixel_beyond_what_is_known():
    def plane(side):
        """Depths of a plane, whose inverse is linear in the image."""
        along = (torch.arange(side, dtype=torch.float64) + 0.5) / side
        return 1 / (0.4 + 0.1 * along[:, None] + 0.05 * along).expand(1, 1, side, side)

    found = enlarge(DepthMaps(plane(24), plane(24) > 0, plane(24)), (60, 60))
    # values are not extrapolated beyond the outermost centres
    inner = (..., slice(2, -2), slice(2, -2))
    torch.testing.assert_close(found[inner], plane(60)[inner], rtol=1e-12, atol=0)
    known = torch.ones(1, 1, 24, 24, dtype=torch.bool)
    known[..., :6] = False
    wrong = torch.where(known, 2.5, 9.0).double()
    found = enlarge(DepthMaps(wrong, known, wrong), (48, 48))
    torch.testing.assert_close(found[..., 10:], torch.full_like(found[..., 10:], 2.5))
    assert (found[..., :9] == 0).all()


def test_coarse_depths_stay_within_bounds():
    near, far = torch.full((2, 1, 2, 2), 1.0), torch.full((2, 1, 2, 2), 3.0)
    bounds, batch = DepthBounds(near, far), make_batch(2, 1, 2, 2)
    depth = torch.tensor([[0.0, 0.5], [2.5, 9.0]]).expand(2, 1, 2, 2)
    coarse = CoarseDepths(depth, torch.ones_like(depth), (True, False))
    others = DepthMaps(near + 0.5, batch.masks, near, bounds)
    found = coarse.maps(batch, bounds, others)
    assert found.depth[0].flatten().tolist() == [2.0, 1.0, 2.5, 3.0]
    assert torch.equal(found.depth[1], others.depth[1])
    assert coarse.step.tolist() == [0.5, 1.0]


def test_tokens_of_copies_are_interpolated_where_the_patches_of_photographs_lie():
    """Values that are linear in the image stay linear, with padding, and next to missing tokens."""
    batch, small, patch = make_batch(1, 2, 98, 108), (56, 70), 14
    padding = pad_to_patches(batch.masks, patch)
    padded = padding.pad_batch(batch)
    rows, columns = (side // patch for side in small)

    def value(x, y):
        """Linear function of the position, in fractions of the image's sides."""
        return torch.stack((2 * x - y + 0.5, 3 * y), -1)

    image, row, column = torch.nonzero(torch.ones(2, rows, columns), as_tuple=True)
    there = (row < 3) | (image == 1)  # the last row of the first view has no tokens
    image, row, column = (each[there] for each in (image, row, column))
    own = value((column + 0.5) / columns, (row + 0.5) / rows)
    tokens = Tokens((own, -own), own[:, :1], image, row, column, (1, 2, rows, columns), patch)
    found = spread_tokens(tokens, padded, patch)
    assert found.shape == (1, 2, padding.height // patch, padding.width // patch, 5)
    v, u = torch.meshgrid(*(torch.arange(n) for n in found.shape[2:4]), indexing="ij")
    x = ((u + 0.5) * patch + padding.left) / 108
    y = ((v + 0.5) * patch + padding.top) / 98
    edge = 0.5 / torch.tensor((columns, rows))
    expected = value(x.clamp(edge[0], 1 - edge[0]), y.clamp(edge[1], 1 - edge[1]))
    torch.testing.assert_close(found[0, 1, ..., :2], expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(found[..., 2:4], -found[..., :2])
    inside = y < 2.5 / rows
    torch.testing.assert_close(found[0, 0, inside, :2], expected[inside], rtol=1e-5, atol=1e-5)
    nearest = value(x.clamp(edge[0], 1 - edge[0]), torch.full_like(y, 2.5 / rows))
    beside = (y > 2.5 / rows) & (y < 3.5 / rows)
    torch.testing.assert_close(found[0, 0, beside, :2], nearest[beside], rtol=1e-5, atol=1e-5)


def test_rounds_start_from_what_is_found_in_a_smaller_copy():
    """Encoder and depth head process the copy alone; rounds start from its final depths and its tokens."""
    batch, seen, tokens = make_batch(1, 3, SIDE, SIDE), [], []
    model = recurrent(HEIGHT, "model.frame=world")  # one frame for both sizes
    model.depth_head.register_forward_hook(lambda head, inputs, maps: seen.append(inputs[1]))
    model.encoder.register_forward_hook(lambda encoder, inputs, result: tokens.append(result))
    model.recalibration.register_forward_hook(lambda stage, inputs, result: tokens.append(inputs[0]))
    with torch.no_grad():
        found = predict(model, batch)
        (copy,) = seen
        of_copy, _, at_full_size = tokens
        size = coarse_sizes(batch, HEIGHT, model.encoder.patch_size)[0]
        assert tuple(copy.masks.shape[2:]) == size
        alone = predict(model, shrink(batch, size, None))
    spread = spread_tokens(of_copy, batch, 14).flatten(0, 3)
    assert torch.equal(torch.cat((*at_full_size.latent, at_full_size.semantic), -1), spread)
    start, bounds = found.rounds[0].depth, found.rounds[0].bounds
    expected = enlarge(alone.depth_maps, (SIDE, SIDE)).clamp(bounds.near, bounds.far)
    known = batch.masks & (enlarge(alone.depth_maps, (SIDE, SIDE)) > 0)
    assert known.sum() > 0.95 * batch.masks.sum()
    torch.testing.assert_close(start[known], expected[known], rtol=1e-5, atol=1e-5)
    assert not torch.equal(found.depth[known], start[known])
    assert len(found.rounds) == model.rounds.count + 1


@pytest.mark.parametrize(
    ("trained", "height", "side"),
    [
        ({"data": {"size": 252}, "augmentation": {"sizes": [140, 252]}}, 202, 252),
        ({"data": {"size": [140, 112]}}, 112, 140),
        ({"data": {"size": 140}, "augmentation": {"sizes": [84, 280]}}, 224, 280),
        ({"data": {"size": None}}, None, None),
        ({}, None, None),
    ],
)
def test_the_training_says_what_height_the_weights_know(trained, height, side):
    nodes = {"rounds": {"kind": "recurrent", "count": 2}, "model": {}}
    assert resolve_height(nodes, trained) == {"rounds": {**nodes["rounds"], "height": height}, "model": {}}
    for said in (None, 60):
        nodes["rounds"]["height"] = said
        assert resolve_height(nodes, trained) == nodes
    assert resolve_height({"model": {}}, trained) == {"model": {}}
    # subjects that fit into an image of the training are never downsampled
    if side is not None:
        batch = make_batch(1, 2, side, side)
        filled = dataclasses.replace(batch, masks=torch.ones_like(batch.masks))
        assert coarse_sizes(filled, height, 14) == [None]
        larger = make_batch(1, 2, side + 14, side + 14)
        for rows, is_copied in ((height, False), (height + 1, True)):
            masks = torch.zeros_like(larger.masks)
            masks[:, 1, :rows, :3] = True  # the tallest view decides
            sizes = coarse_sizes(dataclasses.replace(larger, masks=masks), height, 1)
            assert (sizes != [None]) == is_copied


@pytest.mark.parametrize("pad", ["none", "multiple"])
def test_elements_with_and_without_a_copy_do_not_touch_one_another(pad):
    side = SIDE if pad == "none" else SIDE - 5
    batches = [make_batch(1, 2, side, side, zoom=zoom) for zoom in (0.8, 0.3, 0.6)]  # fewer views
    batches = [in_dtype(dataclasses.replace(batch, depths=None), torch.float64) for batch in batches]
    model = recurrent(HEIGHT, f"model.pad={pad}").double()
    with torch.no_grad():
        together = predict(model, stack_batches(*batches))
        for element, batch in enumerate(batches):
            alone = predict(model, batch)
            close(together.gaussians[element], alone.gaussians, 1e-7)
            valid = alone.depth_valid[0]
            torch.testing.assert_close(
                together.depth[element][valid], alone.depth[0][valid], rtol=1e-7, atol=0
            )


def test_training_reaches_the_depth_head_through_the_copy():
    model = recurrent(HEIGHT).train()
    predict(model, make_batch(1, 3, SIDE, SIDE)).depth.square().mean().backward()
    slopes = [parameter.grad for parameter in model.depth_head.parameters() if parameter.requires_grad]
    assert all(slope is not None and slope.isfinite().all() for slope in slopes)
    assert any(slope.abs().max() > 0 for slope in slopes)
