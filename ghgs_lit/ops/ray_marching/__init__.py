"""Search along rays for the first and the last depth that the other views allow.

On a CPU, the search along a ray stops as soon as its result is known."""

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from ghgs_lit.extents import true_places
from ghgs_lit.geometry.constants import constant, other_images
from ghgs_lit.ops.dispatch import Operator, everything
from ghgs_lit.ops.pool import at_once, even_parts

#: Smallest depth in metres at which masks are looked up; points behind the camera are moved there.
NEAREST = 1e-4
#: Depths in memory at once, on a CPU and elsewhere.
_DEPTHS = 1 << 18, 1 << 23


def look_up(
    tables: Shaped[Tensor, "n h w"], image: Int[Tensor, "..."], pixels: Float[Tensor, "3 ..."]
) -> Tensor:
    """Look up entries of tables at homogeneous pixels.

    Points outside the frame get the entry of the nearest border pixel: a mask that does not touch the
    border contains the whole subject; for other masks see :func:`votes_outside`. Points behind the
    camera are projected far outside the frame.

    Args:
        tables: votes or other values.
        image: index of the table; broadcasts with the pixels.
        pixels: the three homogeneous coordinates of each pixel; overwritten.

    Returns:
        Entries of the shape to which ``image`` and the pixels broadcast.
    """
    height, width = tables.shape[1:]
    inverse = pixels[2].clamp_(min=NEAREST).reciprocal_()
    # Extreme camera parameters overflow to NaN, which cannot be an index.
    places = pixels[:2].mul_(inverse).nan_to_num_().clamp_(min=0)
    last = constant(torch.tensor, (width - 1, height - 1), like=pixels)
    column, row = torch.minimum(places, last.view(2, *[1] * (pixels.dim() - 1))).int()
    place = torch.add(column, row, alpha=width)
    return tables.flatten().take(torch.add(place, image, alpha=height * width))


def _march(
    masks: Bool[Tensor, "B V h w"],
    outside: UInt8[Tensor, "B V h w"],
    matrices: Float[Tensor, "B V 3 4"],
    directions: Float[Tensor, "B V h w 3"],
    centers: Float[Tensor, "B V 3"],
    near: Float[Tensor, "B V h w"],
    far: Float[Tensor, "B V h w"],
    steps: Float[Tensor, " s"],
    tolerance: int,
    rays: Int[Tensor, " r"] | None,
    count: int | None,
) -> tuple[Tensor, Tensor]:
    """Narrow depth bounds to what the other views allow; unchanged where they allow no sampled depth.

    Args:
        masks: foreground pixels, whose rays are marched.
        outside: 1 where a view votes "outside".
        matrices: projection matrices.
        directions: directions of the rays.
        centers: camera centres.
        near: near bounds in metres.
        far: far bounds in metres.
        steps: sampled depths as fractions of the interval from near to far.
        tolerance: largest number of votes against an allowed depth.
        rays: indices of the foreground pixels; None: derived from ``masks``.
        count: upper bound of the number of foreground pixels; None: unknown.

    Returns:
        Near and far bounds in metres [B, V, h, w], half a step outside the first and the last allowed
        sample.
    """
    views = outside.shape[1]
    samples = len(steps)
    bounds = [bound.clone(memory_format=torch.contiguous_format) for bound in (near, far)]
    if rays is None:
        known = count is not None
        rays = true_places(masks, count, repeats=True) if known else masks.flatten().nonzero()[:, 0]
    others = constant(other_images, len(outside), views, like=rays)
    table = matrices.flatten(0, 1).movedim(1, 0)
    most = at_once(near.device, *_DEPTHS) // (samples * (views - 1))
    for part in even_parts(len(rays), most):
        ray = rays[part]
        image = ray // outside[0, 0].numel()
        begin, end = (bound.reshape(-1)[ray] for bound in (near, far))
        length = end - begin
        depth = begin[:, None] + steps * length[:, None]
        direction = directions.reshape(-1, 1, 3)[ray]
        center = centers.reshape(-1, 1, 3)[image]
        other = others[image]
        matrix = table[:, other]
        along = (matrix[..., :3] * direction).sum(-1)
        origin = (matrix[..., :3] * center).sum(-1) + matrix[..., 3]
        pixels = torch.addcmul(origin[..., None], depth[:, None], along[..., None])
        votes = look_up(outside.flatten(0, 1), other[..., None], pixels)
        inside = (votes.sum(1) <= tolerance).to(torch.uint8)
        hit = inside.amax(1).bool()
        half = length / (2 * samples)
        first = depth.gather(1, inside.argmax(1, keepdim=True))[:, 0] - half
        last = depth.gather(1, samples - 1 - inside.flip(1).argmax(1, keepdim=True))[:, 0] + half
        bounds[0].view(-1)[ray] = torch.where(hit, first, begin)
        bounds[1].view(-1)[ray] = torch.where(hit, last, end)
    return bounds[0], bounds[1]


march = Operator(
    "march(Tensor masks, Tensor outside, Tensor matrices, Tensor directions, Tensor centers, Tensor near,"
    " Tensor far, Tensor steps, int tolerance, Tensor? rays, int? count) -> (Tensor, Tensor)",
    _march,
    __name__,
    {"cpu": everything},
)
