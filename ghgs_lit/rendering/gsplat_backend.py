"""gsplat on CUDA. It is imported where it is used; its constants are compiled in."""

import importlib

import torch
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.rendering.settings import RasterSettings
from ghgs_lit.types import Cameras, Gaussians, Rendering

_FIXED = ("alpha_max", "alpha_min", "stop", "extent", "frustum_margin")


class BackendUnavailable(ValueError):
    """The renderer asked for cannot run on this machine; the message says what was tried."""


def load():
    """The ``rasterization`` function of gsplat, or ``BackendUnavailable`` with what was tried."""
    if not torch.cuda.is_available():
        raise BackendUnavailable(
            "renderer.backend=gsplat: needs a CUDA device, but torch.cuda.is_available() is false "
            f"(torch {torch.__version__}, built for CUDA {torch.version.cuda}); use renderer=cpu"
        )
    try:
        return importlib.import_module("gsplat").rasterization
    except Exception as error:
        # Building gsplat's kernels fails in many ways; whatever it says belongs in the message.
        reason = str(error).strip().splitlines()
        raise BackendUnavailable(
            "renderer.backend=gsplat: `import gsplat` failed with "
            f"{type(error).__name__}: {reason[0] if reason else 'no message'}; install the extra with "
            "`pip install 'ghgs-lit[gpu]'` (it needs a CUDA compiler or a prebuilt gsplat wheel for "
            f"torch {torch.__version__}, CUDA {torch.version.cuda})"
        ) from error


def rasterize(
    gaussians: Gaussians, cameras: Cameras, settings: RasterSettings, near: float, far: float
) -> Rendering:
    """Gaussians on black, in float32; see :func:`ghgs_lit.rendering.render`."""
    default = RasterSettings()
    for name in _FIXED:
        value, fixed = getattr(settings, name), getattr(default, name)
        require(value == fixed, f"renderer.settings.{name}", f"{fixed}, which gsplat has compiled in", value)
    rasterization = load()
    channels = gaussians.colors.shape[1]
    elements = [
        _element(rasterization, gaussians[b], cameras[b], settings, near, far)
        for b in range(len(gaussians.splits))
    ]
    nothing = gaussians.means.new_zeros(*cameras.shape, channels + 2, cameras.height, cameras.width)
    image, depth, alpha = (torch.stack(elements) if elements else nothing).split((channels, 1, 1), dim=2)
    return Rendering(image=image, alpha=alpha, depth=depth)


def _element(rasterization, gaussians: Gaussians, cameras: Cameras, settings, near, far) -> Tensor:
    """All views of one batch element, [T, C + 2, h, w]: colours, expected depth, alpha."""
    channels = gaussians.colors.shape[1]
    if len(gaussians) == 0 or cameras.shape[0] == 0:
        # Keeps the graph, so that a batch of empty elements can be differentiated.
        nothing = gaussians.means.sum() + gaussians.colors.sum()
        return nothing.float() * torch.zeros(
            cameras.shape[0], channels + 2, cameras.height, cameras.width, device=gaussians.means.device
        )
    safe = _safe(gaussians)
    values, alpha, _ = rasterization(
        means=safe.means,
        quats=safe.quaternions,
        scales=safe.scales,
        opacities=safe.opacities,
        colors=safe.colors,
        viewmats=cameras.extrinsics.float(),
        Ks=cameras.intrinsics.float(),
        width=cameras.width,
        height=cameras.height,
        near_plane=near,
        far_plane=far,
        eps2d=settings.low_pass,
        render_mode="RGB+ED",
        packed=False,
        rasterize_mode="antialiased" if settings.antialiased else "classic",
    )
    return torch.cat((values, alpha), dim=-1).permute(0, 3, 1, 2)


def _safe(gaussians: Gaussians) -> Gaussians:
    """Float32 Gaussians that gsplat draws as this project defines them.

    Its kernels square quaternions in float32 and do not expect what is not a number: norms become one,
    the zero quaternion identity, and a Gaussian with a geometry or opacity that is not finite invisible.
    """
    means, scales, opacities = gaussians.means.float(), gaussians.scales.float(), gaussians.opacities.float()
    quaternions = gaussians.quaternions.float()
    geometry = torch.cat((means, quaternions, scales, opacities[:, None]), dim=-1)
    is_sound = geometry.isfinite().all(-1)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], device=means.device)
    largest = quaternions.abs().amax(-1, keepdim=True).detach()
    is_turned = is_sound[:, None] & (largest > 0)
    scaled = torch.where(is_turned, quaternions, identity) / torch.where(is_turned, largest, 1)
    return Gaussians(
        means=torch.where(is_sound[:, None], means, 0),
        quaternions=torch.nn.functional.normalize(scaled, dim=-1),
        scales=torch.where(is_sound[:, None], scales, 1),
        opacities=torch.where(is_sound, opacities, 0),
        colors=gaussians.colors.float(),
        splits=gaussians.splits,
    )
