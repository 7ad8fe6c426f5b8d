"""The visual hull as a baseline."""

from ghgs_lit.evaluation.baselines.splats import hull_bounds, hull_depth
from tests.helpers.scenes import make_batch

SIZE = 160


def errors(views):
    """Depths of the hull minus the true ones inside the silhouettes, in footprints of a pixel."""
    batch = make_batch(views=views, height=SIZE, width=SIZE)
    difference = (hull_depth(batch) - batch.depths)[batch.masks]
    return difference * batch.cameras.intrinsics[0, 0, 0, 0] / batch.depths[batch.masks]


def test_the_hull_of_a_convex_body_approaches_its_surface_with_more_views():
    """A convex body is the intersection of its silhouette cones; few of them leave it too thick."""
    few, many = errors(3), errors(24)
    assert many.max() < 0  # never behind the surface
    assert many.median() > -1.6  # masks are dilated by a pixel
    assert few.median() < -2.4
    assert many.abs().mean() < 0.6 * few.abs().mean()


def test_the_hull_is_found_once_for_all_baselines_and_empty_outside_the_subject():
    """Photo-consistency and the start of per-scene fitting search in the same hull."""
    batch = make_batch(2, 3)
    depth = hull_depth(batch)
    assert batch.once(hull_bounds) is batch.once(hull_bounds)
    assert depth.shape == batch.masks.shape
    assert (depth[~batch.masks] == 0).all()
