"""Two other rasterizers for CPUs, with which the project's rasterizer is compared.

``box``: the method of today's CPU tools. Every splat, in depth order, loops over the pixels of its
3-sigma box; compiled by Numba with all optimisations, one thread, colours only, forward and
hand-written backward. ``torch``: tiles of 16 x 16 pixels in plain PyTorch, splats in chunks of 64;
a tile ends early when all of its pixels are opaque; gradients by autograd. Results depend on the
sizes of tile and chunk, so these are fixed.

Both use the reference's projection (plain PyTorch, differentiable) in float32.
"""

import math

import numba
import numpy as np
import torch
from torch import Tensor

from ghgs_lit.rendering import RasterSettings, reference
from ghgs_lit.types import Cameras, Gaussians

_SETTINGS = RasterSettings()
TILE, CHUNK = 16, 64


def _project(gaussians: Gaussians, camera: Cameras) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centres [n, 2], inverse covariances (xx, xy, yy), opacities and colours, front to back;
    radii."""
    index = reference.visible(gaussians, camera, _SETTINGS, 0.01, 1e10)
    splats = reference.project(gaussians.select(index, (len(index),)), camera, _SETTINGS)
    xx, xy, yy = splats.covariances.unbind(-1)
    inverse = torch.stack((yy, -xy, xx), dim=-1) / splats.determinants[:, None]
    with torch.no_grad():
        middle = 0.5 * (xx + yy)
        radii = 3 * (middle + (middle**2 - splats.determinants).clamp_min(0.01).sqrt()).sqrt()
    return splats.centers, inverse, splats.opacities, splats.colors, radii


def render_box(gaussians: Gaussians, camera: Cameras) -> Tensor:
    """Colours [3, h, w] of one camera."""
    *splats, radii = _project(gaussians, camera)
    image = _Box.apply(*(value.contiguous() for value in splats), radii, camera.height, camera.width)
    return image.permute(2, 0, 1)


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _box_forward(centers, inverse, opacities, colors, radii, transmittance, image, last):
    height, width = transmittance.shape
    for n in range(len(centers)):
        u, v, radius, opacity = centers[n, 0], centers[n, 1], radii[n], opacities[n]
        a, b, c = inverse[n, 0], inverse[n, 1], inverse[n, 2]
        red, green, blue = colors[n, 0], colors[n, 1], colors[n, 2]
        for y in range(max(0, int(v - radius)), min(height, int(v + radius) + 1)):
            dy = np.float32(y) + np.float32(0.5) - v
            for x in range(max(0, int(u - radius)), min(width, int(u + radius) + 1)):
                before = transmittance[y, x]
                if before < np.float32(1e-4):
                    continue
                dx = np.float32(x) + np.float32(0.5) - u
                sigma = np.float32(0.5) * (a * dx * dx + c * dy * dy) + b * dx * dy
                if sigma > np.float32(5.55):
                    continue
                alpha = min(np.float32(0.999), opacity * math.exp(-sigma))
                if alpha < np.float32(1 / 255):
                    continue
                weight = alpha * before
                image[y, x, 0] += weight * red
                image[y, x, 1] += weight * green
                image[y, x, 2] += weight * blue
                transmittance[y, x] = before - weight
                last[y, x] = n


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _box_backward(
    centers, inverse, opacities, colors, radii, transmittance, last, upstream, behind, d_centers, d_inverse,
    d_opacities, d_colors,
):  # fmt: skip
    """Back to front; ``behind`` [h, w] is the gradient times the weighted colours
    behind a splat."""
    height, width = transmittance.shape
    for n in range(len(centers) - 1, -1, -1):
        u, v, radius, opacity = centers[n, 0], centers[n, 1], radii[n], opacities[n]
        a, b, c = inverse[n, 0], inverse[n, 1], inverse[n, 2]
        red, green, blue = colors[n, 0], colors[n, 1], colors[n, 2]
        for y in range(max(0, int(v - radius)), min(height, int(v + radius) + 1)):
            dy = np.float32(y) + np.float32(0.5) - v
            for x in range(max(0, int(u - radius)), min(width, int(u + radius) + 1)):
                if n > last[y, x]:
                    continue
                dx = np.float32(x) + np.float32(0.5) - u
                sigma = np.float32(0.5) * (a * dx * dx + c * dy * dy) + b * dx * dy
                if sigma > np.float32(5.55):
                    continue
                raw = opacity * math.exp(-sigma)
                alpha = min(np.float32(0.999), raw)
                if alpha < np.float32(1 / 255):
                    continue
                before = transmittance[y, x] / (np.float32(1) - alpha)
                weight = alpha * before
                d_red, d_green, d_blue = upstream[y, x, 0], upstream[y, x, 1], upstream[y, x, 2]
                value = red * d_red + green * d_green + blue * d_blue
                d_alpha = before * value - behind[y, x] / (np.float32(1) - alpha)
                behind[y, x] += weight * value
                transmittance[y, x] = before
                d_colors[n, 0] += weight * d_red
                d_colors[n, 1] += weight * d_green
                d_colors[n, 2] += weight * d_blue
                if raw >= np.float32(0.999):
                    continue
                d_opacities[n] += d_alpha * alpha / opacity
                d_sigma = -d_alpha * alpha
                d_inverse[n, 0] += np.float32(0.5) * d_sigma * dx * dx
                d_inverse[n, 1] += d_sigma * dx * dy
                d_inverse[n, 2] += np.float32(0.5) * d_sigma * dy * dy
                d_centers[n, 0] -= d_sigma * (a * dx + b * dy)
                d_centers[n, 1] -= d_sigma * (b * dx + c * dy)


class _Box(torch.autograd.Function):
    @staticmethod
    def forward(ctx, centers, inverse, opacities, colors, radii, height, width):
        inputs = [t.detach().numpy() for t in (centers, inverse, opacities, colors, radii)]
        transmittance = np.ones((height, width), np.float32)
        image, last = np.zeros((height, width, 3), np.float32), np.full((height, width), -1, np.int32)
        _box_forward(*inputs, transmittance, image, last)
        ctx.kept = inputs, transmittance, last
        return torch.from_numpy(image)

    @staticmethod
    def backward(ctx, gradient):
        inputs, transmittance, last = ctx.kept
        results = [np.zeros_like(value) for value in inputs[:4]]
        upstream, behind = gradient.contiguous().numpy(), np.zeros_like(transmittance)
        _box_backward(*inputs, transmittance.copy(), last, upstream, behind, *results)
        return *(torch.from_numpy(value) for value in results), None, None, None


def render_torch(gaussians: Gaussians, camera: Cameras) -> Tensor:
    """Colours [3, h, w] of one camera."""
    centers, inverse, opacities, colors, radii = _project(gaussians, camera)
    with torch.no_grad():
        low = ((centers - radii[:, None]) / TILE).floor().long()
        high = ((centers + radii[:, None]) / TILE).floor().long()
    rows = []
    for y in range(-(-camera.height // TILE)):
        in_row = ((low[:, 1] <= y) & (high[:, 1] >= y)).nonzero()[:, 0]
        tiles = []
        for x in range(-(-camera.width // TILE)):
            index = in_row[(low[in_row, 0] <= x) & (high[in_row, 0] >= x)]
            tiles.append(
                _torch_tile(x, y, *(value[index] for value in (centers, inverse, opacities, colors)))
            )
        rows.append(torch.cat(tiles, dim=1))
    return torch.cat(rows)[: camera.height, : camera.width].permute(2, 0, 1)


def _torch_tile(x: int, y: int, centers, inverse, opacities, colors) -> Tensor:
    """One tile [16, 16, 3]."""
    edge = torch.arange(TILE) + 0.5
    pixels = torch.stack(torch.meshgrid(edge + x * TILE, edge + y * TILE, indexing="xy"), dim=-1).view(-1, 2)
    image, transmittance = torch.zeros(TILE * TILE, 3), torch.ones(TILE * TILE)
    for start in range(0, len(centers), CHUNK):
        part = slice(start, start + CHUNK)
        dx, dy = (pixels - centers[part, None]).unbind(-1)
        a, b, c = inverse[part, :, None].unbind(1)
        alpha = opacities[part, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        alpha = torch.where(alpha >= 1 / 255, alpha.clamp_max(0.999), 0)
        behind = transmittance * torch.cumprod(1 - alpha, dim=0)
        before = torch.cat((transmittance[None], behind[:-1]))
        weights = alpha * before * (behind > 1e-4)
        image = image + weights.mT @ colors[part]
        transmittance = behind[-1]
        if not bool((transmittance > 1e-4).any()):
            break
    return image.view(TILE, TILE, 3)
