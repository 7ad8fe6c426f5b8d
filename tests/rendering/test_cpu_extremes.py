"""The CPU backend at the limits: huge, tiny, zero and broken values, and thresholds."""

import dataclasses

import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.rendering import RasterSettings, render
from tests.helpers.splats import (
    FIELDS,
    assert_cpu_matches_reference,
    camera_ring,
    cloud,
    few,
    relative_error,
    with_gradients,
)

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("ratio", [10, 100, 1000, 10000])
def test_long_thin_splats(ratio):
    """Splats up to 10000 times longer than wide lose no accuracy."""
    gaussians = cloud(40)
    long = 1.0 / gaussians.scales.new_tensor([1.0, ratio, ratio])
    assert_cpu_matches_reference(
        dataclasses.replace(gaussians, scales=long.expand(40, 3) * 0.8), camera_ring(2, 40, 40)
    )


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e4, 1e20])
def test_scales_of_any_size(scale):
    """Scales from 0 to 1e20 neither overflow nor disturb other splats."""
    scales, means = [[0.1] * 3, [scale] * 3, [0.1, scale, 0.1]], [[0, 0, 0.2], [0, 0, 0], [0.1, 0, -0.1]]
    assert_cpu_matches_reference(
        few(scales=scales, means=means), camera_ring(1, 20, 20), ambiguous_budget=0.05
    )


def test_negative_scales_mean_their_size():
    """A negative scale is drawn like its absolute value."""
    gaussians, views = cloud(50), camera_ring(1, 24, 24)
    negative = dataclasses.replace(gaussians, scales=-gaussians.scales)
    for backend in ("cpu", "reference"):
        torch.testing.assert_close(
            render(negative, views, backend).image, render(gaussians, views, backend).image, rtol=0, atol=1e-6
        )
    assert_cpu_matches_reference(negative, views)


@pytest.mark.parametrize("norm", [1e-15, 1e15])
def test_quaternions_of_any_norm(norm):
    """Only the direction of a quaternion counts."""
    gaussians, views = cloud(50), camera_ring(1, 24, 24)
    scaled = dataclasses.replace(gaussians, quaternions=gaussians.quaternions * norm)
    assert relative_error(render(scaled, views, "cpu").image, render(gaussians, views, "cpu").image) < 1e-6
    assert_cpu_matches_reference(scaled, views)


def test_the_zero_quaternion_is_identity_without_gradient():
    """A zero quaternion is drawn unrotated and gets no gradient, not NaN."""
    views = camera_ring(1, 20, 20)
    zero = with_gradients(few(quaternions=[[0.0] * 4], scales=[[0.1, 0.2, 0.05]]))
    rendering = render(zero, views, "cpu")
    rendering.image.sum().backward()
    assert torch.equal(rendering.image, render(few(scales=[[0.1, 0.2, 0.05]]), views, "cpu").image)
    assert (zero.quaternions.grad == 0).all()
    assert zero.scales.grad.abs().sum() > 0


@pytest.mark.parametrize("opacity", [0.0, -1.0, NAN])
def test_opacities_that_show_nothing(opacity):
    """Opacities of zero, below zero and NaN draw nothing and give zero gradients."""
    gaussians = with_gradients(few(opacities=[opacity]))
    rendering = render(gaussians, camera_ring(1, 20, 20), "cpu", background=0.5)
    rendering.image.sum().backward()
    assert (rendering.image == 0.5).all()
    assert (rendering.alpha == 0).all()
    assert (rendering.depth == 0).all()
    assert all((getattr(gaussians, name).grad == 0).all() for name in FIELDS)


def test_opacity_one_is_clamped_and_without_gradient_there():
    """A clamped alpha has no gradient in opacity."""
    views = camera_ring(1, 17, 17)
    gaussians = with_gradients(few(opacities=[1.0], scales=[[10.0] * 3]))
    rendering = render(gaussians, views, "cpu")
    rendering.alpha[0, 0, 0, 8, 8].backward()
    assert float(rendering.alpha.detach()[0, 0, 0, 8, 8]) == pytest.approx(0.999, abs=1e-6)
    assert float(gaussians.opacities.grad) == 0
    assert_cpu_matches_reference(few(opacities=[1.0, 0.5], means=[[0, 0, 0], [0, 0, 1]]), views)


def test_opacity_above_one_is_cut_at_the_extent():
    """A splat with an opacity above one ends at the extent."""
    assert_cpu_matches_reference(few(opacities=[50.0], scales=[[0.3] * 3]), camera_ring(1, 32, 32))


@pytest.mark.parametrize("z", [-10.0, -3.0, -2.99, -3.0 + 0.0099])
def test_nothing_nearer_than_near_is_seen(z):
    """Gaussians behind the camera or nearer than ``near`` draw nothing and give zero gradients."""
    gaussians = with_gradients(few(means=[[0.0, 0.0, z]]))
    rendering = render(gaussians, camera_ring(1, 20, 20), "cpu", near=0.015)
    rendering.image.sum().backward()
    assert (rendering.alpha == 0).all()
    assert all((getattr(gaussians, name).grad == 0).all() for name in FIELDS)


def test_exactly_near_and_exactly_far_are_seen():
    """Both ends of the depth range are included."""
    views = camera_ring(1, 20, 20, distance=2.0)
    for options in ({"near": 2.0}, {"far": 2.0}):
        assert float(assert_cpu_matches_reference(few(), views, **options).alpha.detach().max()) > 0.5
    assert float(render(few(), views, "cpu", near=2.0001).alpha.max()) == 0
    assert float(render(few(), views, "cpu", far=1.9999).alpha.max()) == 0


@pytest.mark.parametrize("far_off", [1e8, 1e30, 3e38, INF])
def test_far_off_screen(far_off):
    """Gaussians at huge distances from the frame give no NaN or infinity."""
    for scale in (0.1, 1e8, 1e20):
        gaussians = few(
            means=[[0, 0, 0], [far_off, 0, 0], [0, -far_off, 0]], scales=[[0.1] * 3, [scale] * 3, [scale] * 3]
        )
        gaussians = with_gradients(gaussians)
        rendering = render(gaussians, camera_ring(1, 40, 40), "cpu")
        rendering.image.sum().backward()
        assert torch.isfinite(rendering.image).all()
        assert all(torch.isfinite(getattr(gaussians, name).grad).all() for name in FIELDS)
        if scale < 1:
            assert torch.equal(rendering.image, render(few(), camera_ring(1, 40, 40), "cpu").image)


def test_beyond_the_limit_of_the_jacobian():
    """Wide splats outside the frame, where the Jacobian is clamped,
    equal the reference with gradients."""
    gaussians = few(
        means=[[3.0, 0.1, 0], [-2.5, 0.2, 0.3], [0.2, 2.5, -0.1], [0.1, -4.0, 0.4]], scales=[[1.0, 0.5, 0.7]]
    )
    assert float(assert_cpu_matches_reference(gaussians, camera_ring(1, 32, 32)).alpha.detach().max()) > 0.1


@pytest.mark.parametrize("field", ["means", "quaternions", "scales", "opacities"])
@pytest.mark.parametrize("value", [NAN, INF])
def test_what_is_not_a_number_reaches_no_other_gaussian(field, value):
    """A Gaussian with NaN or infinity in its geometry disturbs no other one."""
    healthy, views = cloud(30, size=0.2), camera_ring(1, 24, 24)
    broken = dataclasses.replace(healthy, **{field: getattr(healthy, field).clone()})
    getattr(broken, field).view(30, -1)[7, 0] = value
    broken = with_gradients(broken)
    rendering = render(broken, views, "cpu")
    rendering.image.sum().backward()
    assert torch.isfinite(rendering.image).all()
    others = torch.arange(30) != 7
    assert all(torch.isfinite(getattr(broken, name).grad[others]).all() for name in FIELDS)
    if not (field == "opacities" and value == INF):
        without = render(healthy.select(others, (29,)), views, "cpu")
        assert torch.equal(rendering.image, without.image)


@pytest.mark.parametrize("value", [NAN, INF])
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_colour_that_is_not_finite_stays_in_its_pixels(backend, value):
    """A broken colour reaches only the pixels that see it, and no gradient of others."""
    views = camera_ring(1, 40, 40)
    scene = few(means=[[-0.3, 0, 0], [0.45, 0.3, 0]], scales=[[0.03] * 3])
    scene.colors[1] = value
    scene = with_gradients(scene)
    rendering = render(scene, views, backend)
    touched = render(few(means=[[0.45, 0.3, 0]], scales=[[0.03] * 3]), views, backend).alpha > 0
    assert torch.equal(torch.isfinite(rendering.image[0, 0, 0]), ~touched[0, 0, 0])
    weights = torch.where(touched, 0.0, 1.0)
    torch.where(touched, 0.0, rendering.image * weights).sum().backward()
    for name in ("means", "scales", "opacities", "quaternions"):
        assert torch.isfinite(getattr(scene, name).grad[0]).all()
    assert scene.opacities.grad[0] != 0


def test_thresholds_at_equality():
    """A splat exactly at ``alpha_min`` or at ``stop`` is treated as the settings define."""
    views = camera_ring(1, 16, 16)
    views.intrinsics[..., :2, 2] = 8.5
    just, below = 1 / 255, 1 / 255 * (1 - 1e-5)
    for backend in ("cpu", "reference"):
        # At the splat's centre, which is a pixel's centre, alpha is the opacity itself.
        scenes = [few(opacities=torch.tensor([o], dtype=torch.float64)) for o in (just * (1 + 1e-6), below)]
        shown = [float(render(scene, views, backend).alpha[0, 0, 0, 8, 8]) for scene in scenes]
        assert shown == [pytest.approx(just, rel=1e-5), 0.0]
    # The transmittance behind the second layer is 1/16:
    # with a ``stop`` of that or more it is left out.
    layers = few(
        means=[[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]], opacities=[0.75, 0.75, 0.01], scales=[[0.5] * 3]
    )

    for stop, wanted in ((1 / 16 * (1 + 1e-6), 0.75), (1 / 16, 0.75), (1 / 16 * (1 - 1e-6), 15 / 16)):
        for backend in ("cpu", "reference"):
            alpha = render(layers, views, backend, settings=RasterSettings(stop=stop)).alpha[0, 0, 0, 8, 8]
            assert float(alpha) == pytest.approx(wanted, abs=1e-6)


def test_antialiased_splats_without_area_vanish():
    """With anti-aliasing a splat without area is invisible and gives no NaN."""
    gaussians = with_gradients(
        few(scales=[[0.0] * 3, [0.2, 0.0, 0.0], [0.1] * 3], means=[[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]])
    )
    views, flat = camera_ring(1, 20, 20), RasterSettings(antialiased=True)
    rendering = render(gaussians, views, "cpu", settings=flat)
    alone = render(few(means=[[0, 0, 0.2]]), views, "cpu", settings=flat)
    rendering.image.sum().backward()
    assert torch.equal(rendering.image, alone.image)
    assert all(torch.isfinite(getattr(gaussians, name).grad).all() for name in FIELDS)


def test_more_splats_in_tiles_than_memory_are_refused_at_once():
    """60 000 splats that fill the frame take 5 GB with their gradients;
    one line, before any is allocated."""
    gaussians = cloud(60_000)
    full = dataclasses.replace(gaussians, scales=torch.full_like(gaussians.scales, 1e4))
    full.means.requires_grad_()
    with pytest.raises(InputError, match=r"cpu: expected .* 4 GiB at most .*4.6 GiB: .* 1019 of each"):
        render(full, camera_ring(1, 512, 512), "cpu")
