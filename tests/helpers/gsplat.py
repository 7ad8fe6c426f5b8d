"""Replacements for gsplat that need no GPU: its whole interface, and its parts."""

import itertools

import pytest
import torch

from ghgs_lit.rendering import RasterSettings, reference
from ghgs_lit.types import Cameras, Gaussians


def functions():
    """gsplat's functions in plain PyTorch, which need no GPU."""
    reason = "needs the package gsplat (it needs no GPU for this test)"
    return pytest.importorskip("gsplat.cuda._torch_impl", reason=reason)


class Documented:
    """A replacement with gsplat's documented interface, whose ``rasterization`` calls the reference."""

    __version__ = "1.4.0"

    @staticmethod
    def rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, far_plane, eps2d,
        render_mode, packed, rasterize_mode,
    ):  # fmt: skip
        assert (render_mode, packed) == ("RGB+ED", False)
        assert all(torch.isfinite(t).all() for t in (means, quats, scales, opacities))
        batch, count = means.shape[:2]
        assert count == 32  # padded to the size of a warp
        assert quats.shape == (batch, count, 4)
        assert opacities.shape == (batch, count)
        assert viewmats.shape[:1] == Ks.shape[:1] == (batch,)
        torch.testing.assert_close(quats.norm(dim=-1), torch.ones(batch, count))
        fields = (x.flatten(0, 1) for x in (means, quats, scales, opacities, colors))
        gaussians = Gaussians(*fields, splits=(count,) * batch)
        settings = RasterSettings(low_pass=eps2d, antialiased=rasterize_mode == "antialiased")
        drawn = reference.rasterize(gaussians, Cameras(Ks, viewmats, height, width), settings, near_plane)
        values = torch.cat((drawn.image, drawn.depth), dim=2).permute(0, 1, 3, 4, 2)
        return values, drawn.alpha.permute(0, 1, 3, 4, 2), {}


class InParts(Documented):
    """A replacement by parts: gsplat's projection in PyTorch, and its rasterization kernel in Python."""

    __version__ = "1.5.3"

    @staticmethod
    def fully_fused_projection(
        means, covars, quats, scales, viewmats, Ks, width, height, eps2d, near_plane, far_plane,
        calc_compensations, opacities,
    ):  # fmt: skip
        assert covars is None
        assert opacities.shape == means.shape[:2]
        covariances, _ = functions()._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        return functions()._fully_fused_projection(
            means, covariances, viewmats, Ks, width, height, eps2d, near_plane, far_plane,
            calc_compensations,
        )  # fmt: skip

    @staticmethod
    def rasterize_to_pixels(
        means2d, conics, colors, opacities, image_width, image_height, tile_size, isect_offsets, flatten_ids,
        masks,
    ):  # fmt: skip
        return drawn_by_tiles(
            means2d, conics, colors, opacities, image_width, image_height, tile_size, isect_offsets,
            flatten_ids, masks,
        )  # fmt: skip


def drawn_by_tiles(centers, conics, colors, opacities, width, height, side, offsets, splats, masks):
    """gsplat's kernel ``rasterize_to_pixels_3dgs_fwd``.

    The list of a tile ends where the next one begins, that of the last tile at the end of all. Tiles
    without a pixel return immediately.
    """
    ends = torch.cat((offsets.flatten()[1:], offsets.new_tensor([len(splats)]))).view_as(offsets)
    centers, conics, colors, opacities = (
        x.flatten(0, 2) for x in (centers, conics, colors, opacities[..., None])
    )
    values = colors.new_zeros(*offsets.shape[:2], height, width, colors.shape[-1])
    alphas = values[..., :1].clone()
    for image in itertools.product(*map(range, offsets.shape[:2])):
        for row, column in itertools.product(*map(range, offsets.shape[2:])):
            y, x = torch.meshgrid(
                torch.arange(row * side, max(row * side, min((row + 1) * side, height))),
                torch.arange(column * side, min((column + 1) * side, width)),
                indexing="ij",
            )
            if y.numel() == 0:
                assert not masks[image][row, column]
                continue
            assert masks[image][row, column]
            own = splats[offsets[image][row, column] : ends[image][row, column]].long()
            d = centers[own] - torch.stack((x, y), -1)[:, :, None] - 0.5
            a, b, c = conics[own].unbind(-1)
            sigma = 0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) + b * d[..., 0] * d[..., 1]
            alpha = (opacities[own][:, 0] * torch.exp(-sigma)).clamp(max=0.999)
            alpha = torch.where((sigma >= 0) & (alpha >= 1 / 255), alpha, 0)
            behind = (1 - alpha).cumprod(-1)
            alpha = torch.where(behind > 1e-4, alpha, 0)
            before = torch.nn.functional.pad(behind, (1, 0), value=1.0)[..., :-1]
            weights = alpha * before
            values[image][y, x] = weights @ colors[own]
            alphas[image][y, x] = weights.sum(-1, keepdim=True)
    return values, alphas
