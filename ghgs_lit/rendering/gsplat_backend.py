"""The gsplat backend (CUDA), imported on first use; most constants are compiled into gsplat.

gsplat's kernels project and rasterize. In predictions and captured training steps, the step in between,
finding the splats of each tile, is done by :mod:`ghgs_lit.ops.intersections`, since gsplat's own
causes a device-to-host synchronisation."""

import importlib
from typing import Any

import torch
from torch import Tensor

from ghgs_lit.errors import InputError, require
from ghgs_lit.ops.intersections import TILE, intersections
from ghgs_lit.ops.rasterization.settings import RasterSettings
from ghgs_lit.rendering.capacity import Room, Rooms, deferred, expected_capacity
from ghgs_lit.types import Cameras, Gaussians, Rendering

#: The limit of alpha that is compiled into gsplat.
_ALPHA_MAX = RasterSettings().alpha_max
#: Threads of a warp. In a batch, gsplat 1.5.3 sums gradients within a warp by a Gaussian's index in
#: its element, which would mix elements with fewer Gaussians than this.
_WARP = 32
#: Farthest depth in metres: practically no limit.
_FAR = 1e10
#: Versions whose kernels are known to accept these intersections.
_KNOWN = ("1.5.3",)


class BackendUnavailable(InputError):
    """The chosen renderer cannot run on this machine; the message gives the reason."""


def load() -> Any:
    """Import gsplat.

    Raises:
        BackendUnavailable: there is no CUDA device, or the import fails.
    """
    if not torch.cuda.is_available():
        raise BackendUnavailable(
            "renderer.backend=gsplat: needs a CUDA device, but torch.cuda.is_available() is false "
            f"(torch {torch.__version__}, built for CUDA {torch.version.cuda}); use renderer.backend=cpu"
        )
    try:
        gsplat = importlib.import_module("gsplat")
        gsplat.rasterization  # noqa: B018
        return gsplat
    except Exception as error:
        # gsplat compiles its kernels on import, which fails in many ways.
        reason = str(error).strip().splitlines()
        raise BackendUnavailable(
            f"renderer.backend=gsplat: `import gsplat` failed with {type(error).__name__}: "
            f"{reason[0] if reason else 'no message'}; install the extra with `pip install "
            "'ghgs-lit[gpu]'` (it needs a CUDA compiler or a prebuilt gsplat wheel for torch "
            f"{torch.__version__}, CUDA {torch.version.cuda})"
        ) from error


def rasterize(gaussians: Gaussians, cameras: Cameras, settings: RasterSettings, near: float) -> Rendering:
    """Render on black in float32; see :func:`ghgs_lit.rendering.render`.

    A limit of alpha below :data:`_ALPHA_MAX` is applied to opacities: for opacities above it,
    alphas differ by at most ``1 - alpha_max`` from those of other backends.

    Args:
        gaussians: on a CUDA device, in metres.
        cameras: [B, T] on the same device, in metres.
        settings: constants of the image.
        near: near plane in metres.

    Returns:
        Image [B, T, 3, h, w], alpha and expected depth [B, T, 1, h, w].

    Raises:
        InputError: a limit of alpha that gsplat's kernels do not support.
        BackendUnavailable: gsplat cannot run on this machine.
    """
    expected = f"at most {_ALPHA_MAX}, which is compiled into gsplat"
    allowed = settings.alpha_max <= _ALPHA_MAX
    require(allowed, "renderer.settings.alpha_max", expected, settings.alpha_max)
    gsplat = load()
    if len(gaussians) == 0 or 0 in cameras.shape:
        # Part of the autograd graph, so that a batch of empty elements can be differentiated.
        nothing = (gaussians.means.sum() + gaussians.colors.sum()).float()
        drawn = nothing * nothing.new_zeros(*cameras.shape, 5, cameras.height, cameras.width)
    else:
        drawn = _render(gsplat, gaussians, cameras, settings, near)
    image, depth, alpha = drawn.split((3, 1, 1), dim=2)
    return Rendering(image=image, alpha=alpha, depth=depth)


def _render(
    gsplat: Any, gaussians: Gaussians, cameras: Cameras, settings: RasterSettings, near: float
) -> Tensor:
    """Render colours, expected depth and alpha [B, T, 5, h, w] of at least one Gaussian and one
    camera."""
    fields = _sanitize(*_pad_elements(gaussians))
    means, quaternions, scales, opacities, colors = fields
    if settings.alpha_max < _ALPHA_MAX:
        # Opacities above the limit keep their gradient,
        # as away from the centre of a splat in other backends.
        opacities = opacities - (opacities - settings.alpha_max).clamp(min=0).detach()
    seen = {
        "means": means,
        "quats": quaternions,
        "scales": scales,
        "opacities": opacities,
        "viewmats": cameras.extrinsics.float(),
        "Ks": cameras.intrinsics.float(),
        "width": cameras.width,
        "height": cameras.height,
        "near_plane": near,
        "far_plane": _FAR,
        "eps2d": settings.low_pass,
    }
    rooms = deferred.get()
    if rooms is not None and gsplat.__version__ in _KNOWN:
        values, alpha = _render_without_sync(gsplat, seen, colors, settings.antialiased, rooms)
    else:
        mode = "antialiased" if settings.antialiased else "classic"
        options = {"render_mode": "RGB+ED", "packed": False, "rasterize_mode": mode}
        values, alpha, _ = gsplat.rasterization(colors=colors, **seen, **options)
    return torch.cat((values, alpha), dim=-1).movedim(-1, -3)


def _render_without_sync(
    gsplat: Any, seen: dict[str, Any], colors: Tensor, antialiased: bool, rooms: Rooms
) -> tuple[Tensor, Tensor]:
    """gsplat's ``rasterization`` without its device-to-host synchronisation.

    Args:
        gsplat: the package, of a version in :data:`_KNOWN`.
        seen: Gaussians and cameras, arguments of gsplat's ``fully_fused_projection``.
        colors: [B, N, 3].
        antialiased: whether to multiply opacities by gsplat's compensations.
        rooms: gets the capacity of the rendering, which may lack splats: the caller checks it.

    Returns:
        Colours and expected depth [B, T, h, w, 4], and alpha [B, T, h, w, 1].
    """
    radii, centers, depths, conics, compensations = gsplat.fully_fused_projection(
        covars=None, calc_compensations=antialiased, **seen
    )
    height = seen["height"]
    width = seen["width"]
    opacities = seen["opacities"][:, None].expand(depths.shape)
    if antialiased:
        opacities = opacities * compensations
    colors = torch.cat((colors[:, None].expand(*depths.shape, -1), depths[..., None]), -1)
    grid = (-(-height // TILE), -(-width // TILE))
    capacity = expected_capacity(grid, depths.numel())
    listed = intersections(centers.detach(), radii, depths.detach(), height, width, capacity)
    rooms.rooms.append(Room(grid, depths.numel(), capacity, listed.needed))
    values, alpha = gsplat.rasterize_to_pixels(
        centers, conics, colors, opacities, width, height, TILE, listed.offsets, listed.splats,
        masks=listed.has_pixels,
    )  # fmt: skip
    depth = values[..., -1:] / alpha.clamp(min=1e-10)
    return torch.cat((values[..., :-1], depth), -1), alpha


def _pad_elements(gaussians: Gaussians) -> tuple[Tensor, ...]:
    """Pad Gaussians to [B, N, ...] in float32 with ones of opacity 0, to at least :data:`_WARP` if
    there are several elements; returns means, quaternions, scales, opacities and colours."""
    names = ("means", "quaternions", "scales", "opacities", "colors")
    fields = [getattr(gaussians, name).float() for name in names]
    if len(gaussians.splits) == 1:
        return tuple(field[None] for field in fields)
    fields[3] = fields[3][:, None]
    packed = torch.cat(fields, dim=-1).split(gaussians.splits)
    padded = torch.nn.utils.rnn.pad_sequence(packed, batch_first=True)
    padded = torch.nn.functional.pad(padded, (0, 0, 0, max(0, _WARP - padded.shape[1])))
    means, quaternions, scales, opacities, colors = padded.split([f.shape[1] for f in fields], dim=-1)
    return means, quaternions, scales, opacities[..., 0], colors


def _sanitize(
    means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor
) -> tuple[Tensor, ...]:
    """Replace values that gsplat would treat unlike the other backends.

    gsplat squares quaternions in float32 and does not handle NaN or infinity. So quaternions are
    normalised, the zero quaternion becomes the identity, and Gaussians whose geometry or opacity is
    not finite become invisible. Returns all five arguments, in order."""
    geometry = torch.cat((means, quaternions, scales, opacities[..., None]), dim=-1)
    is_finite = geometry.isfinite().all(-1)
    identity = torch.nn.functional.pad(means.new_ones(1), (0, 3))
    largest = quaternions.abs().amax(-1, keepdim=True).detach()
    is_rotated = is_finite[..., None] & (largest > 0)
    scaled = torch.where(is_rotated, quaternions, identity) / torch.where(is_rotated, largest, 1)
    return (
        torch.where(is_finite[..., None], means, 0),
        torch.nn.functional.normalize(scaled, dim=-1),
        torch.where(is_finite[..., None], scales, 1),
        torch.where(is_finite, opacities, 0),
        colors,
    )
