"""An analytic subject in front of a ring of cameras, for tests of the stages."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file

from ghgs_lit.data.imperfections import perturb_cameras
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.types import Batch, Cameras, Gaussians, Targets
from tests.helpers.cameras import camera_ring

FIXTURES = Path(__file__).parents[1] / "fixtures"
CASES = json.loads((FIXTURES / "stages_cases.json").read_text())
CENTER, RADII = torch.tensor([0.1, 0.9, 0.0]), torch.tensor([0.25, 0.8, 0.2])


def fixture(name, part, dtype=torch.float32):
    """The tensors of one part (``in``, ``out64``, ``state`` ...) of a fixture, floats in ``dtype``."""
    prefix = part + "/"
    tensors = load_file(FIXTURES / f"{name}.safetensors")
    found = {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}
    return {key: value.to(dtype) if value.is_floating_point() else value for key, value in found.items()}


def ring(batch, views, height, width, spread=360.0, radius=2.0, zoom=0.8):
    """Cameras around the subject that look at it; elements differ by a rotation."""
    focal, principal = zoom * max(height, width), (width / 2 + 1, height / 2 - 1)
    place = {"center": tuple(CENTER.tolist()), "raised": 0.3, "radius": radius, "spread": spread}
    return camera_ring(views, height, width, batch, (focal, focal), principal, **place, turn=20.0)


def ellipsoid(cameras, center=CENTER, radii=RADII):
    """Mask and z-depth of an ellipsoid, from the quadratic equation of each ray in float64."""
    intrinsics, extrinsics = cameras.intrinsics.double(), cameras.extrinsics.double()
    v, u = torch.meshgrid(
        torch.arange(cameras.height) + 0.5, torch.arange(cameras.width) + 0.5, indexing="ij"
    )
    pixels = torch.stack((u, v, torch.ones_like(u)), -1).double()
    rotation = extrinsics[..., :3, :3]
    directions = torch.einsum("...ji,...jk,hwk->...hwi", rotation, intrinsics.inverse(), pixels) / radii
    eye = -(rotation.mT @ extrinsics[..., :3, 3:])[..., 0]
    start = ((eye - center) / radii)[..., None, None, :]
    a, b, c = directions.square().sum(-1), (directions * start).sum(-1), start.square().sum(-1) - 1
    root = b * b - a * c
    mask = root > 0
    return mask, torch.where(mask, (-b - root.clamp(min=0).sqrt()) / a, 0).float()


def painted_ellipsoid(cameras):
    """An ellipsoid whose colour is a smooth function of the surface point; returns images, masks and
    depths."""
    masks, depths = ellipsoid(cameras)
    points = unproject_maps(depths, cameras)
    colors = 0.5 + 0.4 * torch.sin(6 * points + torch.tensor([0.0, 1.0, 2.0]))
    return colors.movedim(-1, -3) * masks[..., None, :, :], masks, depths


def off(batch, pixels=2.0, seeds=(0,)):
    """The batch with camera errors of up to ``pixels``."""
    found = [
        perturb_cameras(batch.cameras[b], batch.masks[b], pixels, np.random.default_rng(seed))
        for b, seed in enumerate(seeds)
    ]
    stacked = (torch.stack([getattr(one, name) for one in found]) for name in ("intrinsics", "extrinsics"))
    return replace(batch, cameras=Cameras(*stacked, batch.cameras.height, batch.cameras.width))


def make_batch(batch=1, views=3, height=56, width=56, **kwargs):
    """An ellipsoid with random colours; ``kwargs`` are passed to :func:`ring`."""
    cameras = ring(batch, views, height, width, **kwargs)
    masks, depths = ellipsoid(cameras)
    images = torch.rand(batch, views, 3, height, width, generator=torch.Generator().manual_seed(3))
    return Batch(images * masks[:, :, None], masks, cameras, depths=depths)


def in_dtype(batch, dtype):
    """The batch with images, cameras and depths, if any, in another precision."""
    depths = None if batch.depths is None else batch.depths.to(dtype)
    return replace(batch, images=batch.images.to(dtype), cameras=batch.cameras.to(dtype), depths=depths)


def with_soft_rims(batch):
    """The batch with a matte that falls from 1 to 0 over two pixels, by which images are premultiplied."""
    alpha = torch.nn.functional.avg_pool2d(batch.masks.float(), 3, 1, 1)
    images = torch.rand(batch.images.shape, generator=torch.Generator().manual_seed(8))
    return replace(batch, images=images * alpha[:, :, None], masks=alpha >= 0.5, alpha=alpha)


def surface_splats(batch):
    """A small opaque Gaussian at the true point of each pixel of the subject."""
    image, pixel = batch.masks.flatten(0, 1).flatten(1).nonzero(as_tuple=True)
    means = unproject_maps(batch.depths, batch.cameras).flatten(0, 1).flatten(1, 2)[image, pixel]
    colors = batch.images.flatten(0, 1).flatten(2).mT[image, pixel]
    n, counts = len(image), tuple(batch.masks.flatten(1).sum(1).tolist())
    turns = torch.tensor([1.0, 0, 0, 0]).expand(n, 4)
    sizes, opacities = torch.full((n, 3), 0.004), torch.full((n,), 0.9)
    return Gaussians(means, turns, sizes, opacities, colors, counts, image, pixel)


def training_batch(batch=1, size=28):
    """:func:`make_batch` with a target for each element, points of the surface, and names."""
    inputs, seen = make_batch(batch, 3, size, size), make_batch(batch, 2, size, size, spread=90.0)
    g = torch.Generator().manual_seed(4)
    directions = torch.nn.functional.normalize(torch.randn(batch, 40, 3, generator=g), dim=-1)
    return replace(
        inputs,
        targets=Targets(seen.images[:, :1], seen.masks[:, :1], seen.cameras[:, :1]),
        body_vertices=list(CENTER + RADII * directions),
        subjects=tuple(f"p{i}" for i in range(batch)),
    )


def stack(batches):
    """Concatenate batches of one size, with images, masks, cameras and depths."""
    tensors = {
        name: torch.cat([getattr(batch, name) for batch in batches]) for name in ("images", "masks", "depths")
    }
    intrinsics, extrinsics = (
        torch.cat([getattr(batch.cameras, name) for batch in batches])
        for name in ("intrinsics", "extrinsics")
    )
    height, width = batches[0].masks.shape[2:]
    return Batch(cameras=Cameras(intrinsics, extrinsics, height, width), **tensors)


def hard_subjects():
    """Batches of one element with extreme masks, by name; their windows differ in size."""
    found = {"small": make_batch(zoom=0.5), "touching_the_border": make_batch(zoom=1.6)}
    for name in ("empty_in_one_view", "full_in_one_view", "single_pixel"):
        batch = make_batch(zoom=0.6)
        masks = batch.masks.clone()
        if name == "single_pixel":
            masks[:] = False
            masks[:, :, 27, 29] = True
        else:
            masks[0, 1] = name == "full_in_one_view"
        found[name] = replace(batch, masks=masks)
    batch = make_batch(zoom=0.6)
    (first, near), (second, far) = (
        ellipsoid(batch.cameras, CENTER + torch.tensor([shift, 0.0, 0.1]), RADII * 0.5)
        for shift in (-0.4, 0.3)
    )
    depths = torch.where(first & ~(second & (far < near)), near, far)
    found["two_people"] = replace(batch, masks=first | second, depths=depths)
    return found
