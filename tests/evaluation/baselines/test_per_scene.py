"""Per-scene 3D Gaussian splatting as a baseline."""

import torch

from ghgs_lit.evaluation.baselines.splats import CHANGES, PerScene, photo_depth
from ghgs_lit.geometry.projection import project
from ghgs_lit.metrics import psnr
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Targets
from tests.helpers.scenes import painted_ellipsoid, ring

RENDERER = Renderer(backend="cpu")


def scene(views=4, size=42):
    """Photographs of a painted ellipsoid, and its second input as the target."""
    around = ring(1, 2 * views, size, size)
    images, masks, _ = painted_ellipsoid(around)
    own = Targets(images[:, 2:3], masks[:, 2:3], around[:, 2:3])
    return Batch(images[:, ::2], masks[:, ::2], around[:, ::2], own)


def test_the_photographs_are_fitted():
    """The render of an input comes nearer to its photograph with steps,
    far beyond what refinement may do."""
    batch = scene()
    method = PerScene(RENDERER, steps=40)
    begin = RENDERER(method.begin(batch), batch.targets.cameras).image
    fitted = method(batch)
    before, after = (psnr(i[0].clamp(0, 1), batch.targets.images[0]).item() for i in (begin, fitted.image))
    assert after > before + 8
    assert fitted.gaussians.splits == (int(batch.masks.sum()),)


def test_every_gaussian_begins_on_its_pixel_and_may_become_another():
    """The start is where photographs agree; position, rotation, scale,
    opacity and colour all change."""
    batch = scene()
    method = PerScene(RENDERER, steps=3)
    begin = method.begin(batch)
    seen = int(batch.masks[0, 0].sum())
    _, depth = project(begin.means[:seen], batch.cameras.intrinsics[0, 0], batch.cameras.extrinsics[0, 0])
    assert torch.allclose(depth, photo_depth(batch)[0, 0][batch.masks[0, 0]], atol=1e-5)
    fitted = method.fitting(begin, batch)
    for name in CHANGES:
        assert (getattr(fitted, name) != getattr(begin, name)).float().mean() > 0.5, name
