"""Perceptual metrics: outlines and depth edges, light outside the subject, sharpness inside it, errors at
a common brightness, and surface error of Gaussians."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from ghgs_lit.metrics import PSNR_CAP, MetricsOptions, surface_error_mm
from ghgs_lit.metrics.functional import psnr_box_40
from ghgs_lit.metrics.regions import depth_edges

SEEN = ("psnr_edge", "spill", "sharpness", "psnr_box_40")
METRICS = MetricsOptions(lpips="off").build()
SIDE = 48


def _people(n=4):
    """Noise on blobs, renders of it, and depths with a step of 2, 5, 10 and 15 cm across the blobs."""
    rng = np.random.default_rng(3)
    masks = ndimage.gaussian_filter(rng.normal(size=(n, SIDE, SIDE)), (0, 5, 5)) > 0.02
    targets = rng.uniform(size=(n, 3, SIDE, SIDE)) * masks[:, None]
    images = np.clip(targets + rng.normal(scale=0.2, size=targets.shape), 0, 1)
    farther = 2.0 + 0.05 * np.arange(n).clip(0.4)[:, None, None]
    depths = np.where(np.arange(SIDE) < SIDE // 2, 2.0, farther) * masks
    return images, targets, masks, depths


def _distance(pixels):
    """Distance in rows and columns from each pixel to the nearest True pixel."""
    return ndimage.distance_transform_cdt(~pixels, "chessboard")


@pytest.mark.parametrize("person", range(4))
def test_what_eyes_see_is_what_scipy_computes(person):
    """References: bands by distance transforms, Laplacians by ndimage, brightness by scaling both images."""
    image, target, mask, depth = (each[person] for each in _people())
    inputs = [torch.from_numpy(each)[None] for each in (image, target, mask)]
    found = METRICS.measure(*inputs, SEEN, torch.from_numpy(depth)[None])
    found = {name: value.item() for name, value in found.items()}
    outside = _distance(mask)
    inside = _distance(~mask)

    # The only step of depths is between two columns, and one of 1 % or of 2.5 % and more.
    edges = np.zeros_like(mask)
    middle = slice(SIDE // 2 - 1, SIDE // 2 + 1)
    edges[:, middle] = mask[:, middle].all(1, keepdims=True) & (person > 0)
    for scale in (0.1, 1, 10):
        assert (depth_edges(torch.from_numpy(scale * depth)[None])[0].numpy() == edges).all()
    outline = np.maximum(outside, inside) <= 2
    band = outline | ndimage.binary_dilation(edges, np.ones((3, 3)))
    squared = ((image - target) ** 2).mean(0)
    assert found["psnr_edge"] == pytest.approx(-10 * np.log10(squared[band].mean()))
    alone = METRICS.measure(*inputs, ["psnr_edge"])["psnr_edge"].item()
    assert alone == pytest.approx(-10 * np.log10(squared[outline].mean()))
    assert (band.sum() > outline.sum()) == (person > 0)

    beside = image.mean(0)[outside > 3].sum()
    assert found["spill"] == pytest.approx(1000 * beside / target.mean(0)[mask].sum())

    inner = inside > 4
    inner[[0, -1]] = False
    inner[:, [0, -1]] = False
    energy = {}
    for name, picture in (("image", image), ("target", target)):
        laplacian = np.stack([ndimage.laplace(channel) for channel in picture])
        energy[name] = (laplacian[:, inner] ** 2).sum()
    assert found["sharpness"] == pytest.approx(energy["image"] / energy["target"])

    rows, columns = (slice(hit.min(), hit.max() + 1) for hit in np.nonzero(mask))
    gain = 0.40 / target[:, mask].mean()
    scaled = (gain * image - gain * target)[:, rows, columns]
    assert found["psnr_box_40"] == pytest.approx(-10 * np.log10((scaled**2).mean()))


def test_what_eyes_see_of_nobody_is_absent():
    """Without subject or light the value is nan, as in all regions; equal images give the cap."""
    images, targets, masks, depths = (torch.from_numpy(each) for each in _people(2))
    nobody = METRICS.measure(images, targets, masks & False, SEEN, 0 * depths)
    assert all(values.isnan().all() for values in nobody.values())
    black = METRICS.measure(images, 0 * targets, masks, SEEN)
    assert [name for name, values in black.items() if values.isnan().all()] == list(SEEN[1:])
    assert (psnr_box_40(targets, targets, masks) == PSNR_CAP).all()


def test_the_surface_error_sees_where_gaussians_end():
    """A plane of points with Gaussians 10 mm above it, a transparent one far away, and an uncovered hole."""
    grid = torch.stack(torch.meshgrid(torch.arange(20.0), torch.arange(20.0), indexing="ij"), -1).flatten(
        0, 1
    )
    surface = torch.cat((grid / 100, torch.zeros(400, 1)), 1)
    above = surface + torch.tensor([0.0, 0.0, 0.01])
    opaque = torch.ones(400)
    assert surface_error_mm(above, opaque, surface).item() == pytest.approx(10, rel=1e-5)
    far = torch.cat((above, torch.tensor([[0.0, 0.0, 5.0]])))
    there = (400 * 10 + 0.01 * 5000) / 400.01
    found = surface_error_mm(far, torch.cat((opaque, torch.tensor([0.01]))), surface).item()
    assert found == pytest.approx((there + 10) / 2, rel=1e-5)
    half = grid[:, 0] < 10
    back = (10 * 200 + sum((10**2 + (10 * k) ** 2) ** 0.5 * 20 for k in range(1, 11))) / 400
    found = surface_error_mm(above[half], opaque[half], surface).item()
    assert found == pytest.approx((10 + back) / 2, rel=1e-5)
    assert surface_error_mm(above, 0.2 * opaque, surface).item() == torch.inf
    assert surface_error_mm(above[:0], opaque[:0], surface).isnan()
    assert surface_error_mm(above, 0 * opaque, surface).isnan()
    broken = torch.cat((above, torch.full((1, 3), torch.nan)))
    assert surface_error_mm(broken, torch.ones(401), surface).item() == pytest.approx(10, rel=1e-5)
