"""Options, refusals and configs of the renderer."""

from pathlib import Path

import pytest
import torch
import yaml
from rendering_scenes import FIELDS, cameras, cloud, leaves

from ghgs_lit.errors import InputError
from ghgs_lit.rendering import BackendUnavailable, RasterSettings, Renderer, gsplat_backend, reference, render
from ghgs_lit.types import Cameras, Gaussians

CONFIGS = sorted((Path(__file__).parents[1] / "conf" / "renderer").glob("*.yaml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_config_builds_a_renderer(path):
    options = yaml.safe_load(path.read_text())
    assert options.pop("_target_") == "ghgs_lit.rendering.Renderer"
    assert Renderer(**options).backend == path.stem


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"backend": "cuda"}, "renderer.backend"),
        ({"near": 0.0}, "renderer.near"),
        ({"near": float("nan")}, "renderer.near"),
        ({"near": 2.0, "far": 1.0}, "renderer.far"),
        ({"background": "white"}, "renderer.background"),
        ({"background": [0.0, float("inf"), 0.0]}, "renderer.background"),
        ({"low_pass": -1.0}, "low_pass"),
        ({"alpha_max": 1.0}, "alpha_max"),
        ({"alpha_min": 0.9999}, "alpha_min"),
        ({"antialiased": 1}, "antialiased"),
        ({"lowpass": 0.3}, "lowpass"),
    ],
)
def test_impossible_options_are_refused_by_name(options, key):
    with pytest.raises(InputError, match=key):
        Renderer(**options)


def test_auto_is_the_cpu_backend_for_cpu_tensors():
    gaussians, views = cloud(20), cameras(2, 20, 30)
    assert torch.equal(Renderer()(gaussians, views).image, render(gaussians, views, "cpu").image)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_backgrounds(backend):
    gaussians, views = cloud(20), cameras(2, 20, 30)
    black = render(gaussians, views, backend)
    behind = 1 - black.alpha
    color = torch.tensor([0.1, 0.5, 0.9])
    for background in (color, (0.1, 0.5, 0.9), color.expand(1, 2, 3)[..., None, None]):
        image = render(gaussians, views, backend, background=background).image
        torch.testing.assert_close(image, black.image + behind * color[:, None, None])
    torch.testing.assert_close(
        Renderer(backend, background=0.5)(gaussians, views, background=1.0).image, black.image + behind
    )
    with pytest.raises(InputError, match="background"):
        render(gaussians, views, backend, background=(0.0, 1.0))


def test_the_background_is_differentiable():
    background = torch.zeros(3, requires_grad=True)
    rendering = render(cloud(20), cameras(1, 20, 30), "cpu", background=background)
    rendering.image.sum().backward()
    torch.testing.assert_close(background.grad, (1 - rendering.alpha).sum().expand(3))


@pytest.mark.skipif(torch.cuda.is_available(), reason="tells what happens without CUDA")
def test_gsplat_without_cuda_says_what_is_missing():
    with pytest.raises(BackendUnavailable, match=r"renderer\.backend=gsplat.*CUDA"):
        render(cloud(5), cameras(1, 8, 8), "gsplat")


def test_gsplat_refuses_constants_it_does_not_know():
    with pytest.raises(ValueError, match="renderer"):
        render(cloud(5), cameras(1, 8, 8), "gsplat", settings=RasterSettings(stop=0.5))


def test_inputs_that_do_not_fit():
    gaussians, views = cloud(20), cameras(2, 20, 30)
    with pytest.raises(InputError, match="cameras"):
        render(gaussians, views[0], "cpu")
    with pytest.raises(InputError, match="cameras"):
        render(cloud(20, splits=(10, 10)), views, "cpu")
    with pytest.raises(InputError, match=r"gaussians\.splits"):
        render(cloud(20, splits=(19,)), views, "cpu")
    skewed = views.intrinsics.clone()
    skewed[..., 0, 1] = 1.0
    with pytest.raises(InputError, match="skew"):
        render(gaussians, type(views)(skewed, views.extrinsics, 20, 30), "cpu")


@pytest.mark.parametrize("region", [(0, 0, 21, 30), (-1, 0, 5, 5), (0, 0, 5), (0.0, 0.0, 5.0, 5.0)])
def test_regions_that_do_not_fit(region):
    with pytest.raises(InputError, match="region"):
        render(cloud(5), cameras(2, 20, 30), "cpu", region=region)


def _stand_in(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, far_plane, eps2d,
    render_mode, packed, rasterize_mode,
):  # fmt: skip
    """gsplat's ``rasterization`` as its documentation has it, drawn by the reference."""
    assert (render_mode, packed) == ("RGB+ED", False)
    assert all(torch.isfinite(t).all() for t in (means, quats, scales, opacities))
    torch.testing.assert_close(quats.norm(dim=-1), torch.ones(len(quats)))
    gaussians = Gaussians(means, quats, scales, opacities, colors, splits=(len(means),))
    settings = RasterSettings(low_pass=eps2d, antialiased=rasterize_mode == "antialiased")
    views = Cameras(Ks[None], viewmats[None], height, width)
    drawn = reference.rasterize(gaussians, views, settings, near_plane, far_plane)
    values = torch.cat((drawn.image, drawn.depth), dim=2)[0].permute(0, 2, 3, 1)
    return values, drawn.alpha[0].permute(0, 2, 3, 1), {}


@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_is_called_as_documented(monkeypatch, antialiased):
    monkeypatch.setattr(gsplat_backend, "load", lambda: _stand_in)
    gaussians, views = cloud(40, splits=(15, 0, 25)), cameras(2, 20, 30, batch=3)
    gaussians.quaternions[3] = 0
    gaussians.quaternions[4] *= 1e-25
    gaussians.means[5, 0] = float("nan")
    settings = RasterSettings(low_pass=0.2, antialiased=antialiased)
    gaussians = leaves(gaussians)
    found = gsplat_backend.rasterize(gaussians, views, settings, 0.5, 20.0)
    wanted = render(gaussians, views, "cpu", settings=settings, near=0.5, far=20.0)
    for name in ("image", "alpha", "depth"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=1e-4, atol=1e-4)
    found.image.sum().backward()
    assert all(torch.isfinite(getattr(gaussians, name).grad).all() for name in FIELDS)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_draws_the_same_image(antialiased):
    pytest.importorskip("gsplat")
    gaussians, views = cloud(500, splits=(200, 0, 300)), cameras(2, 45, 70, batch=3)
    options = {"settings": RasterSettings(antialiased=antialiased), "background": (0.1, 0.5, 0.9)}
    found = render(gaussians.to("cuda"), views.to("cuda"), "gsplat", **options)
    wanted = render(gaussians, views, "cpu", **options)
    for name in ("image", "alpha", "depth"):
        difference = (getattr(found, name).cpu() - getattr(wanted, name)).norm() / getattr(
            wanted, name
        ).norm()
        assert float(difference) < 1e-3
