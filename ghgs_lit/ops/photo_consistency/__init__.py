"""Photo-consistency: agreement of the input views at several depths of each pixel.

It is a plane sweep (Collins, CVPR 1996) within each pixel's own depth bounds, based on the assumption
that a point on the surface has the same colour in all views."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.geometry.constants import constant, middles
from ghgs_lit.geometry.masks import surface_colors
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32, inverse_intrinsics, pixel_centers, sample
from ghgs_lit.ops.dispatch import Operator, everything
from ghgs_lit.ops.pool import even_parts
from ghgs_lit.types import Batch, DepthBounds

#: Samples in memory at once.
_SAMPLES = 1 << 22

#: Mean absolute difference of two colours at which the consistency is 1 / e.
TOLERANCE = 0.1

#: Smallest cosine between the optical axes of two compared views (127 degrees): beyond it they hardly
#: share any surface.
WIDEST = -0.6


@torch.no_grad()
def photo_consistency(batch: Batch, bounds: DepthBounds, steps: int) -> Float[Tensor, "B V S H W"]:
    """Agreement of each foreground pixel with the best other view at S depths, without a gradient.

    Args:
        batch: provides images, masks and cameras.
        bounds: near and far depth of each pixel, in the unit of the cameras.
        steps: S, the number of depths: the centres of S equal intervals from near to far.

    Returns:
        [B, V, S, H, W] in [0, 1]; 0 in the background, and where no other view has the point in its
        mask.
    """
    near, far = (bound.flatten()[batch.pixels] for bound in (bounds.near, bounds.far))
    agreement = consistency_of(batch, batch.pixels, near, far, steps)
    result = agreement.new_zeros(batch.masks.numel(), steps).index_copy_(0, batch.pixels, agreement)
    return result.view(*batch.masks.shape, steps).permute(0, 1, 4, 2, 3)


@torch.no_grad()
def consistency_of(
    batch: Batch, pixels: Int[Tensor, " N"], near: Float[Tensor, " N"], far: Float[Tensor, " N"], steps: int
) -> Float[Tensor, "N S"]:
    """:func:`photo_consistency` of selected foreground pixels.

    Args:
        batch: provides images, masks and cameras.
        pixels: ascending indices [N] among the pixels of all images.
        near: smallest depth of each of these pixels [N], in the unit of the cameras.
        far: largest depth of each of these pixels [N].
        steps: S, the number of depths: the centres of S equal intervals from near to far.

    Returns:
        [N, S] in [0, 1].
    """
    near = at_least_float32(near)
    far = at_least_float32(far)
    # Errors of half a pixel, as in bfloat16, would select another colour.
    with exact(batch.masks.device.type):
        views = [x.to(near) if x.is_floating_point() else x for x in batch.once(_pairs)]
        colors = batch.once(_smooth if near.dtype == torch.float32 else _smooth_plainly).to(near)
        return _sweep(pixels, near, far, colors, *views, *batch.masks.shape[2:], steps, TOLERANCE)


def _sweep_depths(
    pixels: Int[Tensor, " N"],
    near: Float[Tensor, " N"],
    far: Float[Tensor, " N"],
    colors: Float[Tensor, "B V 4 H W"],
    turn: Float[Tensor, "B V V 3 3"],
    shift: Float[Tensor, "B V V 3"],
    compared: Bool[Tensor, "B V V"],
    height: int,
    width: int,
    steps: int,
    tolerance: float,
) -> Float[Tensor, "N S"]:
    """:func:`consistency_of` in plain PyTorch.

    Args:
        pixels: indices among the pixels of all images.
        near: smallest depths, in the unit of the cameras.
        far: largest depths, in the unit of the cameras.
        colors: smoothed images and their masks, from :func:`_smooth_colors`.
        turn: matrices from pixels of a view (second axis) to another (third axis); see
            :func:`_relations`.
        shift: added in the other view; see :func:`_relations`.
        compared: whether two views are compared.
        height: image height in pixels, used only by kernels, whose ``colors`` are flat.
        width: image width in pixels, likewise.
        steps: S, the number of depths.
        tolerance: mean difference of colours at which the agreement is 1 / e.

    Returns:
        [N, S] in [0, 1].
    """
    shares = constant(middles, steps, like=near)
    result = near.new_zeros(len(pixels), steps)
    for part in even_parts(len(pixels), _SAMPLES // (steps * (colors.shape[1] - 1))):
        depth = near[part, None] + (far - near)[part, None] * shares
        result[part] = _best_match(pixels[part], depth, colors, turn, shift, compared, tolerance)
    return result


def _pairs(batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    cameras = [at_least_float32(x) for x in (batch.cameras.intrinsics, batch.cameras.extrinsics)]
    turn, shift, facing = _relations(*cameras)
    return turn, shift, ~(facing < WIDEST)


def _best_match(
    pixels: Int[Tensor, " n"],
    depth: Float[Tensor, "n S"],
    colors: Float[Tensor, "B V 4 H W"],
    turn: Float[Tensor, "B V V 3 3"],
    shift: Float[Tensor, "B V V 3"],
    compared: Bool[Tensor, "B V V"],
    tolerance: float,
) -> Float[Tensor, "n S"]:
    """Agreement [n, S] in [0, 1] of pixels at their depths with the best other view; arguments as in
    :func:`_sweep_depths`."""
    views, _, height, width = colors.shape[1:]
    image = pixels // (height * width)
    place = pixels % (height * width)
    centers = F.pad(pixel_centers(height, width, depth).flatten(0, 1)[place], (0, 1), value=1.0)
    flat = colors.flatten(0, 1)
    pixel_colors = flat.flatten(2)[image, :3, place]
    k = (image[:, None] + torch.arange(1, views, device=image.device)) % views
    pair = image[:, None] * views + k
    rays = (turn.flatten(0, 2)[pair] * centers[:, None, None]).sum(-1)
    other = image[:, None] // views * views + k
    agreement = _match(flat, other, pixel_colors, rays, shift.flatten(0, 2)[pair], depth, tolerance)
    return torch.where(compared.flatten()[pair][..., None], agreement, 0).amax(1)


def _match(
    images: Tensor,
    image: Tensor,
    pixel_colors: Tensor,
    rays: Tensor,
    shift: Tensor,
    depth: Tensor,
    tolerance: float,
) -> Tensor:
    """Agreement of the colours of pixels with those of other images at their depths.

    Args:
        images: smoothed colours and masks of all m images [m, 4, H, W].
        image: indices of the o images with which each pixel is compared [n, o].
        pixel_colors: colours of the pixels [n, 3].
        rays: change of a point's homogeneous pixel in these images per unit of depth [n, o, 3].
        shift: homogeneous pixel of the pixel's camera centre in these images [n, o, 3].
        depth: depths of each pixel [n, S].
        tolerance: mean difference of colours at which the agreement is 1 / e.

    Returns:
        [n, o, S] in [0, 1].
    """
    points = rays[:, :, None] * depth[:, None, :, None] + shift[:, :, None]
    z = points[..., 2]
    front = z > 0
    pixels = points[..., :2] / torch.where(front, z, 1.0)[..., None]
    seen = sample(images, image[..., None].expand(z.shape), pixels)
    difference = (seen[..., :3] - pixel_colors[:, None, None]).abs().mean(-1)
    return torch.exp(-difference / tolerance) * seen[..., 3] * front


def _smooth(batch: Batch) -> Tensor:
    return _smoothing(batch.once(surface_colors), batch.masks)


def _smooth_plainly(batch: Batch) -> Tensor:
    return _smooth_colors(batch.once(surface_colors), batch.masks)


def _smooth_colors(
    images: Float[Tensor, "B V 3 H W"], masks: Bool[Tensor, "B V H W"]
) -> Float[Tensor, "B V 4 H W"]:
    """Mean colours of the foreground pixels in 3 x 3 windows, and the mask as a fourth channel,
    [B, V, 4, H, W].

    Pixels that are not finite are removed from the mask: they would spread through sums and samples.
    """
    inside = (masks & images.sum(2).isfinite())[:, :, None]
    both = torch.cat((torch.where(inside, images, 0), inside.to(images.dtype)), 2)
    for axis in (-2, -1):  # several times as fast as an average pool
        both = _sum_of_three(both, axis)
    colors = both[:, :, :3] / torch.where(both[:, :, 3:] > 0, both[:, :, 3:], 1.0)
    return torch.cat((colors, inside.to(colors)), 2)


def _sum_of_three(values: Tensor, axis: int) -> Tensor:
    """Sum of each value and its two neighbours along an axis, with 0 outside."""
    sums = values.clone()
    inner = values.shape[axis] - 1
    sums.narrow(axis, 1, inner).add_(values.narrow(axis, 0, inner))
    sums.narrow(axis, 0, inner).add_(values.narrow(axis, 1, inner))
    return sums


def _relations(
    intrinsics: Float[Tensor, "B V 3 3"], extrinsics: Float[Tensor, "B V 4 4"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Maps from pixels of a view j to pixels of a view k: ``z_k p_k = z_j turn p_j + shift``.

    Args:
        intrinsics: K in pixels [B, V, 3, 3].
        extrinsics: world to camera [B, V, 4, 4].

    Returns:
        ``turn`` [B, j, k, 3, 3], ``shift`` [B, j, k, 3], and the cosines between the optical axes of
        the views [B, j, k].
    """
    rotation = extrinsics[..., :3, :3]
    translation = extrinsics[..., :3, 3:]
    relative = rotation[:, None] @ rotation[:, :, None].mT
    turn = intrinsics[:, None] @ relative @ inverse_intrinsics(intrinsics)[:, :, None]
    shift = intrinsics[:, None] @ (translation[:, None] - relative @ translation[:, :, None])
    return turn, shift[..., 0], relative[..., 2, 2].clone()


#: On a CPU, the colours are one flat array, the layout of the CPU kernel of :data:`_sweep`.
_smoothing = Operator(
    "smoothed(Tensor images, Tensor masks) -> Tensor", _smooth_colors, __name__, {"cpu": everything}
)
_sweep = Operator(
    "swept(Tensor pixels, Tensor near, Tensor far, Tensor colors, Tensor turn, Tensor shift, "
    "Tensor compared, int height, int width, int steps, float tolerance) -> Tensor",
    _sweep_depths,
    __name__,
    {"cpu": lambda pixels, near, far, colors, *others: colors.dim() == 1, "cuda": everything},
)
