"""Photo-consistent depth as a baseline."""

import pytest
import torch

from ghgs_lit.evaluation.baselines.splats import _shared, hull_bounds, hull_depth, photo_depth
from ghgs_lit.types import Batch
from tests.helpers.scenes import painted_ellipsoid, ring


def painted(views=8, height=64, width=56):
    cameras = ring(1, views, height, width)
    images, masks, depths = painted_ellipsoid(cameras)
    return Batch(images, masks, cameras, depths=depths)


def test_colours_say_where_in_the_hull_the_surface_is():
    """Nearer to the truth than the hull's front and than its middle,
    on photographs that are not square."""
    batch = painted()
    found, bounds = photo_depth(batch), batch.once(hull_bounds)

    def error(depth):
        return (depth - batch.depths)[batch.masks].abs().mean()

    assert error(found) < 0.6 * error(hull_depth(batch))
    assert error(found) < 0.6 * error((bounds.near + bounds.far) / 2)
    assert (found[~batch.masks] == 0).all()
    inside = found[batch.masks]
    assert (inside >= bounds.near[batch.masks]).all()
    assert (inside <= bounds.far[batch.masks]).all()


def test_a_body_of_one_colour_stands_between_the_ends_of_its_hull():
    """No depth is better than another: what remains is a mean, not the first or a random one."""
    batch = painted(views=4)
    batch = Batch(0.5 * batch.masks[:, :, None].expand_as(batch.images), batch.masks, batch.cameras)
    bounds = batch.once(hull_bounds)
    share = ((photo_depth(batch) - bounds.near) / (bounds.far - bounds.near))[batch.masks]
    assert share.median() == pytest.approx(0.5, abs=0.2)


def test_evidence_is_shared_inside_the_subject_only():
    """A mean over the pixels of the mask in the window, by its definition."""
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(2, 3, 4, 9, 7, generator=generator)
    masks = torch.rand(2, 3, 9, 7, generator=generator) > 0.4
    found = _shared(values, masks, 2)
    for b, v, row, column in masks.nonzero()[::11].tolist():
        window = (b, v, slice(max(row - 2, 0), row + 3), slice(max(column - 2, 0), column + 3))
        part = values[window[0], window[1], :, window[2], window[3]]
        expected = part[:, masks[window]].mean(1)
        assert torch.allclose(found[b, v, :, row, column], expected, atol=1e-5)
