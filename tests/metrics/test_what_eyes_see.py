"""Metrics of what eyes see: light beside the subject, sharpness inside it, where Gaussians end."""

import pytest
import torch

from ghgs_lit.metrics import surface_error_mm
from ghgs_lit.metrics.functional import region_of, sharpness, spill


def test_light_beside_the_subject_and_sharpness_inside_it():
    """Light on a ring of known size; a blur of known effect on a grating; the band of the outline."""
    mask = torch.zeros(1, 40, 40, dtype=torch.bool)
    mask[:, 10:30, 10:30] = True
    target = 0.5 * mask[:, None].expand(-1, 3, -1, -1).float()
    image = target.clone()
    image[..., 10:30, 33] = 0.25  # four columns beside the outermost pixel: counts
    image[..., 10:30, 32] = 1.0  # three: does not
    assert spill(image, target, mask).item() == pytest.approx(1000 * 20 * 0.25 / (400 * 0.5))
    assert spill(image, target, ~mask & mask).isnan().all()
    phase = torch.pi * torch.arange(40.0) / 2
    grating = (0.5 + 0.2 * torch.cos(phase)).expand(1, 3, 40, 40)
    blurred = (grating.roll(1, -1) + grating.roll(-1, -1) + 2 * grating) / 4  # halves this frequency
    assert sharpness(blurred, grating, mask).item() == pytest.approx(0.25, rel=1e-4)
    assert sharpness(grating, grating, mask).item() == 1
    assert sharpness(grating, torch.ones_like(grating), mask).isnan().all()
    outside = torch.where(mask[:, None], grating, torch.rand(1, 3, 40, 40))
    assert sharpness(outside, grating, mask).item() == 1
    band = region_of(mask, "edge")
    assert band.sum().item() == 24 * 24 - 16 * 16
    assert not band[:, 12:28, 12:28].any()


def test_the_surface_error_sees_where_gaussians_end():
    """A plane of points: Gaussians 10 mm above it, a transparent one far away, a hole that nothing covers."""
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
