"""The CPU backend against the reference in float64: images, alphas, depths and every gradient."""

import dataclasses

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ghgs_lit.rendering import RasterSettings, render
from tests.helpers.splats import (
    assert_cpu_matches_reference,
    body,
    camera_ring,
    cloud,
    few,
    relative_error,
    with_gradients,
)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(("height", "width"), [(45, 70), (16, 32), (1, 1), (3, 33)])
def test_random_scenes(height, width, antialiased):
    """Image and gradients equal the reference for images of any size,
    with and without anti-aliasing."""
    assert_cpu_matches_reference(
        cloud(150, size=0.1), camera_ring(2, height, width), RasterSettings(antialiased=antialiased)
    )


def test_a_body_of_pixel_sized_splats():
    """The typical scene, a closed surface of pixel-sized splats, equals the reference."""
    rendering = assert_cpu_matches_reference(
        body(2000, 48), camera_ring(1, 48, 48), background=(0.1, 0.3, 0.6)
    )
    assert 0.15 < float((rendering.alpha > 0.5).float().mean()) < 0.3


def test_elements_with_different_numbers_of_gaussians():
    """An element's image does not depend on the other elements, and an empty one is background."""
    gaussians = cloud(100, splits=(0, 70, 1, 29))
    rendering = assert_cpu_matches_reference(gaussians, camera_ring(3, 20, 36, batch=4), background=0.5)
    assert (rendering.alpha[0] == 0).all()
    assert (rendering.image[0] == 0.5).all()
    for element in (1, 3):
        alone = render(gaussians[element], camera_ring(3, 20, 36), "cpu", background=0.5)
        assert torch.equal(alone.image[0], rendering.image[element])


@pytest.mark.parametrize("channels", [1, 2, 8, 9, 20])
def test_any_number_of_channels(channels):
    """Colours with more or fewer channels than a splat's record holds equal the reference."""
    assert_cpu_matches_reference(cloud(60, channels=channels, size=0.2), camera_ring(1, 20, 20))


def test_other_constants():
    """All constants of the settings reach the kernels."""
    other = RasterSettings(
        low_pass=0.05, alpha_max=0.9, alpha_min=0.02, stop=0.01, extent=2.0, frustum_margin=0.1
    )
    assert_cpu_matches_reference(cloud(80, size=0.3), camera_ring(1, 24, 24), other)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 60),
    size=st.floats(1e-4, 3.0),
    distance=st.floats(0.3, 30.0),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
)
def test_scenes_of_any_kind(seed, count, size, distance, height, width):
    """Random sizes, distances and image sizes equal the reference."""
    gaussians = cloud(count, seed, size)
    views = camera_ring(1, height, width, distance=distance)
    # Behind alpha = 0.999 rounding errors of 1e-7 in the gradient are divided by 1 - alpha = 1e-3.
    assert_cpu_matches_reference(
        gaussians, views, image_budget=5e-5, gradient_budget=2e-3, ambiguous_budget=0.1, near=0.05
    )


@pytest.mark.parametrize("views", [0, 2])
def test_no_gaussians(views):
    """Without Gaussians the image is background and gradients are empty."""
    gaussians = with_gradients(cloud(0, splits=(0, 0)))
    rendering = render(
        gaussians, camera_ring(max(views, 1), 20, 30, batch=2)[:, :views], "cpu", background=0.25
    )
    assert rendering.image.shape == (2, views, 3, 20, 30)
    assert (rendering.image == 0.25).all()
    assert (rendering.alpha == 0).all()
    rendering.image.sum().backward()
    assert gaussians.means.grad.shape == (0, 3)


def test_no_cameras_and_no_elements():
    """Batches without cameras or elements give empty images and zero gradients."""
    gaussians = with_gradients(cloud(5))
    rendering = render(gaussians, camera_ring(2, 20, 30)[:, :0], "cpu")
    rendering.image.sum().backward()
    assert rendering.image.shape == (1, 0, 3, 20, 30)
    assert (gaussians.means.grad == 0).all()
    empty = render(cloud(0, splits=()), camera_ring(2, 20, 30)[:0], "cpu")
    assert empty.image.shape == (0, 2, 3, 20, 30)


def test_one_splat_over_the_whole_image():
    """A splat that covers all tiles equals the reference."""
    assert_cpu_matches_reference(few(scales=[[3.0, 2.0, 4.0]]), camera_ring(1, 50, 90))


def test_thousands_of_equal_depths_keep_their_order():
    """Splats of equal depth are drawn in the order of their index."""
    gaussians = few(means=torch.zeros(3000, 3), scales=[[0.05, 0.07, 0.03]], opacities=[0.01])
    colors = torch.rand(3000, 3, generator=torch.Generator().manual_seed(3))
    assert_cpu_matches_reference(
        dataclasses.replace(gaussians, colors=colors), camera_ring(1, 8, 8), ambiguous_budget=0.3
    )
    two = few(means=torch.zeros(2, 3), opacities=[0.9, 0.9], colors=[[1.0, 0, 0], [0, 1.0, 0]])
    red, green = render(two, camera_ring(1, 20, 20), "cpu").image[0, 0, :2].unbind(0)
    torch.testing.assert_close(green, red * (1 - red))


def test_hundreds_of_opaque_layers():
    """Many opaque layers, where pixels end early, equal the reference."""
    gaussians = cloud(400, size=2.0)
    assert_cpu_matches_reference(
        dataclasses.replace(gaussians, opacities=torch.full((400,), 1.0)), camera_ring(1, 24, 24)
    )


def test_inputs_of_any_layout_and_dtype():
    """Strided, float64 and bfloat16 inputs are converted,
    and gradients come back in their dtype."""
    plain, views = cloud(40), camera_ring(1, 24, 24)
    wanted = render(plain, views, "cpu").image
    strided = dataclasses.replace(
        plain,
        means=plain.means.T.contiguous().T,
        scales=torch.stack((plain.scales, plain.scales), dim=-1)[..., 0],
        opacities=plain.opacities[:, None].expand(40, 2)[:, 1],
    )
    assert not strided.scales.is_contiguous()
    assert torch.equal(render(strided, views, "cpu").image, wanted)
    double = with_gradients(plain, torch.float64)
    rendering = render(double, views, "cpu")
    rendering.image.sum().backward()
    assert double.means.grad.dtype == torch.float64
    assert relative_error(rendering.image, wanted) < 1e-6
    half = render(plain.to(torch.bfloat16), views, "cpu")
    assert half.image.dtype == torch.float32


def test_gradients_of_only_some_inputs():
    """Gradients of some inputs equal those computed for all."""
    gaussians, views = cloud(40), camera_ring(1, 24, 24)
    everything = with_gradients(gaussians)
    render(everything, views, "cpu").image.sum().backward()
    colors = gaussians.colors.clone().requires_grad_()
    render(dataclasses.replace(gaussians, colors=colors), views, "cpu").image.sum().backward()
    assert torch.equal(colors.grad, everything.colors.grad)
    assert gaussians.means.grad is None
