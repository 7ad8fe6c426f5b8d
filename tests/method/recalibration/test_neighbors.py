"""Neighbours against their definition: ties, few points, points of all magnitudes."""

import pytest
import torch

from ghgs_lit.ops.neighbors import nearest_neighbors
from tests.helpers.tokens import literal_neighbors, make_stage, scene


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("k", [1, 2, 3, 7, 64])
def test_neighbors_are_those_of_the_definition(k, dtype):
    """Neighbours come from all views and include the point itself; if there are fewer, all are neighbours."""
    for count in (0, 1, 2, 9, 43):
        points = torch.rand(count, 3, dtype=dtype, generator=torch.Generator().manual_seed(1))
        for moved in (points, points + 1000.0):  # far from the origin, too
            near = nearest_neighbors(moved, torch.arange(count) % 3, k)
            assert near.shape == (count, min(k, count))
            for i, row in enumerate(near.tolist()):
                assert row == literal_neighbors(moved, i, k)
    for counts in (((1, 0, 0), (1, 2, 0)), ((0, 0, 0), (3, 0, 0)), ((0, 0, 0), (0, 0, 0))):
        tokens, points = scene(counts)
        found = make_stage(k=k)(tokens, points)
        assert all(layer.isfinite().all() for layer in found.latent)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ties_on_the_image_plane_favor_no_view_and_no_side(dtype):
    """Regression: views share positions there, so most distances are equal; views with lower indices had
    a quarter more neighbours."""
    tokens, points = scene(((144, 144, 144, 144),), grid=(12, 12))
    module = make_stage(neighborhood="image_plane", k=48)
    position = module.positions(tokens, points).to(dtype)
    near = nearest_neighbors(position, tokens.image, 48, module.places(tokens), tokens.grid[1])
    inside = (tokens.row - 5.5).abs().maximum((tokens.column - 5.5).abs()) < 2
    index = near[inside]
    turn = (tokens.image[index] - tokens.image[inside, None]) % 4
    counts = [(turn == t).sum(1) for t in range(4)]
    assert [c.float().mean().item() for c in counts] == [12] * 4
    assert all(c.min() == c.max() for c in counts)
    # The neighbours of one view lie around the query: within one place of balanced.
    offset = position[index] - position[inside, None]
    for t in range(4):
        drift = torch.where((turn == t)[..., None], offset, 0).sum(1) / tokens.patch_size
        assert drift.abs().max() <= 3
    # Distances come first: nothing nearer is left out.
    distance = torch.cdist(position[inside], position)
    farthest = distance.gather(1, index).amax(1)
    assert torch.equal(farthest, distance.sort(1).values[:, 47])


def test_neighbors_on_the_image_plane_are_those_of_whole_photographs():
    """Dropped patches do not shift the others: the ablation would otherwise align the views."""
    tokens, points = scene(((16, 16, 16),))
    module = make_stage(neighborhood="image_plane", k=5)
    left = tokens.image == 1
    left |= tokens.row > 2
    kept = tokens.select(~left)
    place = 2 * torch.stack((kept.row, kept.column), -1) + 1
    assert torch.equal(module.positions(kept, points), place.float())
    assert torch.equal(module.places(kept), module.places(tokens)[~left])


def test_ties_go_to_the_lower_index():
    """Equal distances give the same neighbours on every machine."""
    points = torch.zeros(700, 3)
    points[300:] = 1
    found = nearest_neighbors(points, torch.zeros(700, dtype=torch.int64), 5)
    assert (found[:300] == torch.arange(5)).all()
    assert (found[300:] == torch.arange(300, 305)).all()


def test_blocks_do_not_change_the_neighbors(monkeypatch):
    """Searching in blocks to save memory gives the same neighbours."""
    points = torch.rand(90, 3)
    view = torch.arange(90) % 3
    expected = nearest_neighbors(points, view, 7)
    monkeypatch.setattr("ghgs_lit.ops.neighbors._BLOCK", 1000)
    found = nearest_neighbors(points, view, 7)
    assert torch.equal(found, expected)


def test_points_of_all_sizes_have_neighbors():
    """Huge, tiny and broken points give valid indices, and broken points are never neighbours."""
    points = torch.rand(40, 3) * torch.logspace(-20, 25, 40)[:, None]
    points[7], points[8] = float("nan"), float("inf")
    found = nearest_neighbors(points, torch.zeros(40, dtype=torch.int64), 8)
    assert ((found >= 0) & (found < 40)).all()
    rest = found[[i for i in range(40) if i not in (7, 8)]]
    assert ((rest != 7) & (rest != 8)).all()


def test_at_each_place_of_the_image_plane_the_own_view_comes_first():
    """With one more neighbour than views, the additional one is from the query's own view."""
    tokens, points = scene(((16, 16, 16, 16),))
    module = make_stage(neighborhood="image_plane", k=5)
    places, views = module.places(tokens), tokens.grid[1]
    near = nearest_neighbors(module.positions(tokens, points), tokens.image, 5, places, views)
    turn = (tokens.image[near] - tokens.image[:, None]) % 4
    assert torch.equal(turn, torch.tensor([0, 1, 2, 3, 0]).expand(64, 5))
