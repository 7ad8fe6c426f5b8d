"""gsplat: its PyTorch projection as an independent check, the arguments of its calls, and its image on a
GPU."""

import dataclasses
import inspect
import sys
import types
from functools import partial

import pytest
import torch

from ghgs_lit.rendering import (
    BackendUnavailable,
    RasterSettings,
    gsplat_backend,
    reference,
    render,
)
from ghgs_lit.rendering.capacity import repeat_until_sufficient
from ghgs_lit.types import Cameras
from tests.helpers.gsplat import Documented, InParts, functions
from tests.helpers.splats import (
    FIELDS,
    camera_ring,
    cloud,
    differentiate,
    few,
    relative_error,
    with_gradients,
)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("distance", [3.0, 0.8])
def test_projection_is_that_of_gsplat(distance, antialiased):
    """Centres, inverse covariances, depths, opacities and their gradients equal those of gsplat's
    projection."""
    gaussians, views = with_gradients(cloud(200), torch.float64), camera_ring(3, 40, 50, distance=distance)
    views = Cameras(views.intrinsics.double(), views.extrinsics.double(), 40, 50)
    settings = RasterSettings(antialiased=antialiased)
    covariances, _ = functions()._quat_scale_to_covar_preci(
        gaussians.quaternions, gaussians.scales, compute_preci=False
    )
    _, centers, depths, conics, compensations = functions()._fully_fused_projection(
        gaussians.means, covariances, views.extrinsics[0], views.intrinsics[0], 50, 40,
        eps2d=settings.low_pass, calc_compensations=True,
    )  # fmt: skip
    fields = [gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities]
    compared = 0
    for view in range(3):
        splats = reference.project(gaussians, views[0, view], settings)
        xx, xy, yy = splats.covariances.unbind(-1)
        found = [
            splats.centers,
            torch.stack((yy, -xy, xx), dim=-1) / splats.determinants[:, None],
            splats.depths[:, None],
            splats.opacities[:, None],
        ]
        opacities = gaussians.opacities * compensations[view] if antialiased else gaussians.opacities
        wanted = [centers[view], conics[view], depths[view][:, None], opacities[:, None]]
        front = splats.depths.detach() > 0.05
        compared += int(front.sum())
        slopes = []
        for values in (found, wanted):
            table = torch.cat([value[front] for value in values], dim=-1)
            weights = torch.randn(
                table.shape, generator=torch.Generator().manual_seed(view), dtype=table.dtype
            )
            slopes.append(torch.autograd.grad((table * weights).sum(), fields, retain_graph=True))
        for ours, theirs in zip(found, wanted, strict=True):
            torch.testing.assert_close(ours[front], theirs[front], rtol=1e-6, atol=1e-9)
        for ours, theirs in zip(*slopes, strict=True):
            assert relative_error(ours, theirs) < 1e-6
    assert compared > 400


@pytest.mark.skipif(torch.cuda.is_available(), reason="tests the error without CUDA")
def test_gsplat_without_cuda_says_what_is_missing():
    """Without CUDA, the error names the backend and the reason."""
    with pytest.raises(BackendUnavailable, match=r"renderer\.backend=gsplat.*CUDA"):
        render(cloud(5), camera_ring(1, 8, 8), "gsplat")


@pytest.mark.parametrize("broken", [None, types.ModuleType("gsplat")])
def test_a_broken_gsplat_says_why_it_cannot_be_loaded(monkeypatch, broken):
    """A gsplat built for another PyTorch, or half removed, raises before anything is rendered."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat", broken)
    with pytest.raises(BackendUnavailable, match=r"`import gsplat` failed with (ModuleNotFound|Attribute)"):
        gsplat_backend.load()


def test_gsplat_refuses_constants_it_does_not_know():
    """A constant that is compiled into gsplat cannot be changed silently."""
    with pytest.raises(ValueError, match="alpha_max"):
        gsplat_backend.rasterize(cloud(5), camera_ring(1, 8, 8), RasterSettings(alpha_max=0.9999), 0.5)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("gsplat", [Documented, InParts])
def test_gsplat_is_called_as_documented(monkeypatch, gsplat, antialiased):
    """gsplat gets finite, normalised inputs, is called once per batch, and its output is read as
    documented; kernels of other versions may read the lists of tiles differently and are called whole."""
    monkeypatch.setattr(gsplat_backend, "load", lambda: gsplat)
    gaussians, views = cloud(40, splits=(15, 0, 25)), camera_ring(2, 20, 30, batch=3)
    gaussians.quaternions[3] = 0
    gaussians.quaternions[4] *= 1e-25
    gaussians.means[5, 0] = float("nan")
    gaussians.opacities[15:] = 1  # gsplat limits alpha itself, not opacity
    settings = RasterSettings(low_pass=0.2, antialiased=antialiased)
    gaussians = with_gradients(gaussians)
    found = repeat_until_sufficient(partial(gsplat_backend.rasterize, gaussians, views, settings, 0.5))
    wanted = render(gaussians, views, "cpu", settings=settings, near=0.5)
    for name in ("image", "alpha", "depth"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=1e-4, atol=1e-4)
    found.image.sum().backward()
    assert all(torch.isfinite(getattr(gaussians, name).grad).all() for name in FIELDS)


def test_a_lower_limit_of_alpha_applies_to_opacities_and_keeps_their_gradient(monkeypatch):
    monkeypatch.setattr(gsplat_backend, "load", lambda: Documented)
    gaussians, views = cloud(40, splits=(15, 0, 25)), camera_ring(2, 20, 30, batch=3)
    drawn = []
    for opacity, limit in ((0.9, 0.5), (0.5, 0.999)):
        leaves = with_gradients(dataclasses.replace(gaussians, opacities=torch.full((40,), opacity)))
        image = gsplat_backend.rasterize(leaves, views, RasterSettings(alpha_max=limit), 0.5).image
        image.square().sum().backward()
        drawn.append((image, leaves.opacities.grad))
    torch.testing.assert_close(*drawn)
    assert drawn[0][1].any()


def test_the_gradient_in_parts_is_that_of_the_reference(monkeypatch):
    """Gradients flow through projection, lists of tiles and rasterization to all attributes."""
    monkeypatch.setattr(gsplat_backend, "load", lambda: InParts)
    gaussians, views = cloud(80, splits=(45, 35)), camera_ring(2, 40, 50, batch=2)
    weights = torch.randn(2, 2, 3, 40, 50, generator=torch.Generator().manual_seed(1))
    slopes = []
    for module in (gsplat_backend, reference):
        leaves = with_gradients(gaussians)
        draw = partial(module.rasterize, leaves, views, RasterSettings(), 0.5)
        image = repeat_until_sufficient(draw).image
        (image * weights).sum().backward()
        slopes.append(leaves)
    for name in FIELDS:
        found, wanted = (getattr(leaves, name).grad for leaves in slopes)
        assert relative_error(found, wanted) < 1e-3


def test_every_argument_is_one_of_gsplat():
    """The arguments and defaults in use exist in the installed gsplat."""
    gsplat = pytest.importorskip("gsplat", reason="needs the package gsplat (it needs no GPU for this test)")
    for name in ("fully_fused_projection", "rasterize_to_pixels"):
        called = list(inspect.signature(getattr(InParts, name)).parameters)
        theirs = list(inspect.signature(getattr(gsplat, name)).parameters)
        assert set(called) <= set(theirs)
        assert called[:9] == theirs[:9]
    assert gsplat.__version__ in gsplat_backend._KNOWN
    parameters = inspect.signature(gsplat.rasterization).parameters
    assert set(inspect.signature(Documented.rasterization).parameters) <= set(parameters)
    defaults = {"radius_clip": 0.0, "sh_degree": None, "backgrounds": None, "camera_model": "pinhole"}
    assert {name: parameters[name].default for name in defaults} == defaults


def at_thresholds():
    """Opacities just below and above 1/255; ten opaque splats behind one another, which saturate before
    the last; one nearer than ``near``; one behind the camera."""
    z = [0.0, 0.0, *(0.2 + 0.05 * i for i in range(10)), -2.995, -4.0]
    x = [-0.4, 0.4, *(0.02 * i for i in range(10)), 0.0, 0.0]
    means = torch.tensor([x, [0.01] * len(x), z]).T
    opacities = [0.9 / 255, 1.2 / 255, *[0.9, 1.0] * 5, 1.0, 1.0]
    colors = torch.rand(len(x), 3, generator=torch.Generator().manual_seed(0))
    # Three different scales: the rotation of a sphere has no gradient.
    gaussians = few(means=means, opacities=opacities, colors=colors, scales=[[0.06, 0.1, 0.14]])
    return dataclasses.replace(gaussians, splits=(0, len(x), 0))


@pytest.mark.gpu
@pytest.mark.parametrize("gaussians", [cloud(500, splits=(200, 0, 300)), at_thresholds()])
@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_draws_the_same_image_with_the_same_gradients(antialiased, gaussians):
    """On a GPU, gsplat gives the CPU backend's image and gradients."""
    pytest.importorskip("gsplat")
    views = camera_ring(2, 45, 70, batch=3)
    options = {"settings": RasterSettings(antialiased=antialiased), "background": (0.1, 0.5, 0.9)}
    generator = torch.Generator().manual_seed(7)
    weights = [torch.randn(3, 2, c, 45, 70, generator=generator, dtype=torch.float64) for c in (3, 1, 1)]
    wanted, slopes = differentiate(gaussians, views, "cpu", torch.float32, weights, **options)
    there = gaussians.to("cuda"), views.to("cuda"), "gsplat", torch.float32, [w.cuda() for w in weights]
    found, others = differentiate(*there, **options)
    for name in ("image", "alpha", "depth"):
        assert relative_error(getattr(found, name).cpu(), getattr(wanted, name)) < 1e-3
    for name in FIELDS:
        assert relative_error(others[name].cpu(), slopes[name]) < 1e-2
