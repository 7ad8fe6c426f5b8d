"""Removing Gaussians: unseen ones change nothing, others no more than the bound."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ghgs_lit.errors import InputError
from ghgs_lit.rendering import RasterSettings, cull, render
from ghgs_lit.types import Gaussians
from tests.helpers.splats import FIELDS, body, camera_ring, cloud, with_gradients

OPEN = RasterSettings(stop=0.0)


def _scattered() -> Gaussians:
    """Two batch elements; half of the Gaussians are behind the cameras, far off screen or transparent."""
    gaussians = cloud(200, size=0.1, splits=(120, 80))
    gaussians.means[::4] *= 40
    gaussians.opacities[1::7] = 0.003
    return gaussians


@pytest.mark.parametrize("antialiased", [False, True])
def test_what_is_unseen_changes_nothing(antialiased):
    """Removing unseen Gaussians changes no bit of the image or of a gradient."""
    constants = RasterSettings(antialiased=antialiased)
    views, gaussians = camera_ring(2, 40, 56, batch=2), with_gradients(_scattered())
    culled = cull(gaussians, views, near=0.5, far=20.0, settings=constants)
    assert 40 < len(culled.gaussians) < 160
    assert sum(culled.gaussians.splits) == int(culled.kept.sum())
    assert float(culled.bound.max()) == 0

    def draw(some):
        rendering = render(some, views, "cpu", near=0.5, far=20.0, settings=constants)
        fields = [getattr(gaussians, name) for name in FIELDS]
        return rendering, torch.autograd.grad(rendering.image.square().sum(), fields)

    (wanted, slopes), (found, others) = draw(gaussians), draw(culled.gaussians)
    for name in ("image", "alpha", "depth"):
        assert torch.equal(getattr(found, name), getattr(wanted, name))
    assert all(torch.equal(a, b) for a, b in zip(others, slopes, strict=True))


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), opacity=st.floats(0, 1), size=st.floats(0, 3), spread=st.floats(0.01, 0.3))
def test_what_is_left_out_changes_no_more_than_the_bound(seed, opacity, size, spread):
    """The error of removing faint and tiny Gaussians stays within the bound."""
    gaussians, views = cloud(80, seed, spread), camera_ring(2, 24, 30)
    culled = cull(gaussians, views, opacity, size, settings=OPEN)
    whole, part = (
        render(g, views, "reference", background=0.5, settings=OPEN)
        for g in (gaussians.to(torch.float64), culled.gaussians.to(torch.float64))
    )
    slack = 2e-6  # rounding of float32 alphas near one
    assert ((whole.alpha - part.alpha).abs() <= culled.bound + slack).all()
    assert ((whole.image - part.image).abs() <= culled.bound + slack).all()


def test_tiny_splats_of_a_body_cost_little_and_the_bound_says_how_much():
    """The bound of one removed splat is its own alpha."""
    gaussians, views = body(2000, 64), camera_ring(1, 64, 64)
    gaussians.scales[::10] *= 0.01
    culled = cull(gaussians, views, size=0.05, settings=OPEN)
    assert len(culled.gaussians) == 1800
    assert 0 < float(culled.bound.mean()) < 0.3
    lone = cull(gaussians.select(slice(0, 1), (1,)), views, size=0.05, settings=OPEN)
    change = render(gaussians.select(slice(0, 1), (1,)), views, "cpu", settings=OPEN).alpha
    torch.testing.assert_close(lone.bound, change)


def test_what_cannot_be_culled_by_is_refused():
    """Impossible thresholds are refused with their key."""
    with pytest.raises(InputError, match=r"cull\.opacity"):
        cull(cloud(3), camera_ring(1, 8, 8), opacity=1.5)
    with pytest.raises(InputError, match=r"cull\.size"):
        cull(cloud(3), camera_ring(1, 8, 8), size=-1.0)
