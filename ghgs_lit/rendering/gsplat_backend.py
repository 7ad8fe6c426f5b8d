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
    values, alpha, _ = rasterization(
        means=gaussians.means.float(),
        quats=_safe_quaternions(gaussians.quaternions.float()),
        scales=gaussians.scales.float(),
        opacities=gaussians.opacities.float(),
        colors=gaussians.colors.float(),
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


def _safe_quaternions(quaternions: Tensor) -> Tensor:
    """Unit quaternions of any non-zero norm, identity for zero: gsplat squares components in float32."""
    largest = quaternions.abs().amax(-1, keepdim=True).detach()
    is_zero = largest == 0
    scaled = quaternions / torch.where(is_zero, torch.ones_like(largest), largest)
    identity = torch.zeros_like(scaled)
    identity[:, 0] = 1
    return torch.nn.functional.normalize(torch.where(is_zero, identity, scaled), dim=-1)
