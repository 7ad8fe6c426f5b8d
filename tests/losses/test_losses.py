"""Losses against SciPy, kornia, the authors' numbers and finite differences."""

import dataclasses

import pytest
import torch
from scipy.spatial.distance import cdist

from ghgs_lit.errors import InputError
from ghgs_lit.geometry import chamfer as geometry_chamfer
from ghgs_lit.geometry.chamfer import chamfer, chamfer_of_rows, nearest, nearest_by_products
from ghgs_lit.losses import terms
from ghgs_lit.metrics.functional import ssim_map
from ghgs_lit.types import DepthMaps, Rendering
from tests.helpers.losses import losses_of
from tests.helpers.training import Standin, example_batch


def _example(body: bool = True, depths: bool = True):
    """A prediction, its rendering and a batch: two people in two views with one target."""
    g = torch.Generator().manual_seed(0)
    batch = example_batch(views=2)
    shape = batch.masks.shape
    batch = dataclasses.replace(
        batch,
        masks=torch.rand(shape, generator=g) > 0.5,
        body_vertices=batch.body_vertices if body else None,
        depths=torch.rand(shape, generator=g) + 1 if depths else None,
    )
    prediction = Standin()(batch)
    depth, valid = torch.rand(shape, generator=g) + 1, torch.rand(shape, generator=g) > 0.2
    pixels = torch.rand(*shape, 3, generator=g)
    prediction = dataclasses.replace(
        prediction,
        depth=depth,
        depth_valid=valid,
        points=dataclasses.replace(prediction.points, pixels=pixels, valid=valid),
        depth_maps=DepthMaps(depth, valid, torch.ones_like(depth)),
    )
    image, ones = torch.rand(2, 1, 3, *shape[2:], generator=g), torch.ones(2, 1, 1, *shape[2:])
    return prediction, Rendering(image, ones, ones), batch


def _reference_chamfer(a: torch.Tensor, b: torch.Tensor) -> float:
    squared = cdist(a.double().numpy(), b.double().numpy(), "sqeuclidean")
    return squared.min(1).mean() + squared.min(0).mean()


@pytest.mark.parametrize("away", [0.0, 500.0])
def test_products_find_the_nearest_as_a_tree_does(monkeypatch, away):
    """Also with small blocks, far from the origin, with one reference, and without queries."""
    monkeypatch.setattr(geometry_chamfer, "_DISTANCES", 7000)
    generator = torch.Generator().manual_seed(3)
    a, b = (torch.randn(n, 3, generator=generator) + away for n in (999, 2000))
    found, expected = nearest_by_products(a, b), nearest(a, b)
    assert (found == expected).float().mean() > 0.995
    distances = [(b[index] - a).square().sum(-1).double() for index in (found, expected)]
    assert (distances[0] - distances[1]).abs().max() < 1e-6
    assert nearest_by_products(a, b[:1]).tolist() == [0] * 999
    assert len(nearest_by_products(a[:0], b)) == 0


def test_chamfer_is_scipys():
    """The Chamfer distance equals SciPy's, and is float32 for half-precision input."""
    g = torch.Generator().manual_seed(1)
    a, b = torch.rand(120, 3, generator=g), torch.rand(90, 3, generator=g)
    assert chamfer(a, b).item() == pytest.approx(_reference_chamfer(a, b), rel=1e-6)
    assert chamfer(a.bfloat16(), b).dtype == torch.float32


@pytest.mark.parametrize("count", [0, 1, 3, 200])
def test_points_that_do_not_count_change_nothing(count):
    """Invalid points affect neither the distance nor its gradient, compared with a k-d tree on the valid
    ones."""
    points = torch.rand(260, 3, generator=torch.Generator().manual_seed(count))
    references = torch.rand(150, 3, generator=torch.Generator().manual_seed(7)) + 0.3
    counts = torch.zeros(260, dtype=torch.bool)
    counts[torch.randperm(260, generator=torch.Generator().manual_seed(1))[:count]] = True
    slopes = []
    for filling in (0.0, torch.nan):
        rows = torch.where(counts[:, None], points, filling).requires_grad_()
        found = chamfer_of_rows(rows, counts, references)
        own = points[counts].requires_grad_()
        expected = chamfer(own, references)
        torch.testing.assert_close(found, expected, rtol=2e-6, atol=0)
        found.backward()
        expected.backward()
        slope = torch.zeros_like(points)
        slope[counts] = own.grad
        torch.testing.assert_close(rows.grad, slope, rtol=2e-6, atol=1e-8)
        slopes.append(rows.grad)
    assert torch.equal(*slopes)


def test_a_point_that_counts_and_is_not_finite_is_seen():
    points = torch.zeros(4, 3)
    points[2, 1] = torch.inf
    counts = torch.tensor([True, True, False, True])
    references = torch.ones(2, 3)
    assert chamfer_of_rows(points, counts, references).isfinite()
    assert chamfer_of_rows(points, ~counts, references).isnan()
    assert chamfer_of_rows(points[:2], counts[:2], references * torch.nan).isnan()


def test_chamfer_of_empty_and_of_broken_sets():
    """Empty sets give 0, coincident points a zero gradient, and infinite points nan."""
    points = torch.zeros(0, 3, requires_grad=True)
    value = chamfer(points, torch.rand(5, 3))
    value.backward()
    assert value.item() == 0
    assert chamfer(torch.rand(5, 3), torch.zeros(0, 3)).item() == 0
    one_broken = torch.zeros(4, 3).index_fill(0, torch.tensor([2]), torch.nan)
    assert chamfer(one_broken, torch.rand(7, 3)).isnan()
    coincident = torch.rand(4, 3, requires_grad=True)
    chamfer(coincident, coincident.detach()).backward()
    assert torch.equal(coincident.grad, torch.zeros(4, 3))
    assert chamfer(torch.full((3, 3), torch.inf), torch.rand(5, 3)).isnan()


def test_the_total_is_the_weighted_sum_of_reference_terms():
    """Every term and the total equal independent computations."""
    kornia = pytest.importorskip("kornia")
    prediction, rendering, batch = _example()
    weights = {"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 1.5, "depth": 0.5}
    total, values = losses_of(weights)(prediction, rendering, batch)
    image, target = rendering.image.flatten(0, 1), batch.targets.images.flatten(0, 1)
    ssim = kornia.metrics.ssim(image, target, 11, padding="valid").mean()
    used = prediction.points.valid & batch.masks
    clouds = [
        _reference_chamfer(prediction.points.pixels[b][used[b]], batch.body_vertices[b]) for b in range(2)
    ]
    expected = {
        "render_l1": (image - target).abs().mean().item(),
        "render_ssim": 1 - ssim.item(),
        "chamfer": sum(clouds) / 2,
        "depth": (prediction.depth - batch.depths).abs()[used].mean().item(),
    }
    assert {k: v.item() for k, v in values.items()} == pytest.approx(expected, rel=1e-4)
    assert total.item() == pytest.approx(sum(weights[k] * expected[k] for k in weights), rel=1e-4)


def test_silhouettes_are_compared_with_the_masks_of_targets():
    prediction, rendering, batch = _example()
    masks = batch.targets.masks.clone()
    masks[0], masks[1] = True, False
    batch = dataclasses.replace(batch, targets=dataclasses.replace(batch.targets, masks=masks))
    missing = (1 - rendering.alpha[0].double()).mean()
    too_much = rendering.alpha[1].double().mean()
    total, values = losses_of(weights={"render_l1": 0, "render_ssim": 0, "chamfer": 0, "silhouette": 0.5})(
        prediction, rendering, batch
    )
    assert values.keys() == {"silhouette"}
    assert values["silhouette"].item() == pytest.approx((missing + too_much).item() / 2, rel=1e-6)
    assert total.item() == pytest.approx(values["silhouette"].item() / 2, rel=1e-6)


@pytest.mark.parametrize("part", [(0, 1, 0, 1), (30, 41, 39, 40), (5, 25, 12, 30), (0, 0, 0, 0)])
def test_ssim_of_images_that_differ_in_a_part(part):
    """Value and gradient equal those of the whole map."""
    top, bottom, left, right = part
    g = torch.Generator().manual_seed(5)
    target = torch.rand(2, 1, 3, 41, 40, generator=g, dtype=torch.float64)
    image = target.clone()
    image[1, ..., top:bottom, left:right] = 0.5
    rendering = Rendering(image.requires_grad_(), image[:, :, :1], image[:, :, :1])
    prediction, _, batch = _example()
    masks = torch.ones(2, 1, 41, 40, dtype=torch.bool)
    batch = dataclasses.replace(batch, targets=dataclasses.replace(batch.targets, images=target, masks=masks))
    value = terms.render_ssim(prediction, rendering, batch)
    expected = 1 - ssim_map(image.flatten(0, 1), target.flatten(0, 1)).mean()
    torch.testing.assert_close(value, expected, atol=1e-12, rtol=0)
    slopes = [torch.autograd.grad(x, image)[0] for x in (value, expected)]
    torch.testing.assert_close(*slopes, atol=1e-12, rtol=0)


def test_terms_of_weight_zero_are_not_computed():
    """A term of weight 0 needs no data."""
    prediction, rendering, batch = _example(body=False, depths=False)
    losses = losses_of({"render_l1": 1.0, "chamfer": 0.0, "depth": 0.0})
    total, values = losses(prediction, rendering, batch)
    assert not losses.reads_depths
    assert losses_of({"depth": 0.5}).reads_depths
    assert list(values) == ["render_l1"]
    assert total == values["render_l1"]


@pytest.mark.parametrize("term", ["chamfer", "depth"])
def test_a_term_that_the_data_cannot_feed_is_an_error(term):
    """A term without its data raises an error that names its key."""
    prediction, rendering, batch = _example(body=False, depths=False)
    with pytest.raises(InputError, match=rf"loss\.weights\.{term}"):
        losses_of({term: 1.0})(prediction, rendering, batch)


def test_losses_without_any_subject_pixel_are_zero():
    """A batch without subject pixels gives 0, not nan."""
    prediction, rendering, batch = _example()
    batch = dataclasses.replace(batch, masks=torch.zeros_like(batch.masks))
    _, values = losses_of({"chamfer": 1.0, "depth": 1.0})(prediction, rendering, batch)
    assert values["chamfer"].item() == 0
    assert values["depth"].item() == 0


def test_pixels_that_show_a_part_of_the_subject_have_depths():
    """With a matte, all pixels with a matte above 0 belong to the subject."""
    prediction, rendering, batch = _example()
    soft = dataclasses.replace(batch, alpha=torch.full_like(batch.depths, 0.2))
    value = losses_of({"depth": 1.0})(prediction, rendering, soft)[1]["depth"]
    error = (prediction.depth - batch.depths).abs()[prediction.depth_valid].mean()
    assert value.item() == pytest.approx(error.item(), rel=1e-5)


def test_subsampled_chamfer_is_unbiased():
    """Matching random subsets changes the loss by noise only."""
    prediction, rendering, batch = _example()
    _, full = losses_of({"chamfer": 1.0})(prediction, rendering, batch)
    torch.manual_seed(0)
    few = losses_of({"chamfer": 1.0}, chamfer_points=25)
    values = torch.stack([few(prediction, rendering, batch)[1]["chamfer"] for _ in range(200)])
    assert len(values.unique()) > 100  # each step samples other points
    assert values.mean().item() == pytest.approx(full["chamfer"].item(), rel=0.1)


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (
            {"weights": {"render_l2": 1.0}},
            r"loss\.weights\.render_l2: expected one of chamfer, .*mean render_l1",
        ),
        ({"weights": {"mine": 0.0}}, r"loss\.weights\.mine: expected one of"),
        ({"weights": {"render_l1": -1.0}}, r"loss\.weights\.render_l1"),
        ({"weights": {"render_l1": 0.0}}, r"loss\.weights: expected at least one weight above 0"),
        (
            {"weights": {"chamfer": 1.0}, "chamfer_points": 0},
            r"loss\.chamfer_points: expected an integer",
        ),
        ({"weights": {"depth": 1.0}, "depth": "metres"}, r"loss.depth: .*'depth'"),
    ],
)
def test_impossible_values_name_their_key(arguments, key):
    """Impossible options are rejected by key."""
    with pytest.raises(InputError, match=key):
        losses_of(**arguments)
