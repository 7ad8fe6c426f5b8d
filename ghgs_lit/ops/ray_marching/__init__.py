"""Search along rays for the first and the last depth that other views allow; on a CPU each ray ends as
soon as its result is known."""

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from ghgs_lit.extents import true_places
from ghgs_lit.geometry.constants import constant, other_images
from ghgs_lit.ops.dispatch import Operator, everything
from ghgs_lit.ops.pool import at_once, even_parts

#: The smallest depth in metres at which masks are looked up;
#: points behind the camera are moved there.
NEAREST = 1e-4
#: Depths in memory at once, on a CPU and elsewhere.
_DEPTHS = 1 << 18, 1 << 23


def look_up(
    tables: Shaped[Tensor, "n h w"], image: Int[Tensor, "..."], pixels: Float[Tensor, "3 ..."]
) -> Tensor:
    """Entries of tables at homogeneous pixels.

    Points outside the frame take the entry of the nearest border pixel: a mask that does not
    touch the border has the whole subject in its frame, and :func:`votes_outside` says what the
    others know. Points behind the camera land far outside the frame.

    Args:
        tables: of votes or other values.
        image: which table; broadcasts with the pixels.
        pixels: the three coordinates of each; overwritten.

    Returns:
        Entries of the shape that ``image`` and the pixels broadcast to.
    """
    height, width = tables.shape[1:]
    inverse = pixels[2].clamp_(min=NEAREST).reciprocal_()
    # Cameras of absurd sizes overflow to NaN, which has no index.
    places = pixels[:2].mul_(inverse).nan_to_num_().clamp_(min=0)
    last = constant(torch.tensor, (width - 1, height - 1), like=pixels)
    column, row = torch.minimum(places, last.view(2, *[1] * (pixels.dim() - 1))).int()
    place = torch.add(column, row, alpha=width)
    return tables.flatten().take(torch.add(place, image, alpha=height * width))


def _marched(
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
    """Bounds that the other views allow; unchanged where there are none.

    Args:
        masks: the subject's pixels, whose rays are marched.
        outside: 1 where a view votes "outside".
        matrices: of projection.
        directions: of the rays.
        centers: of the cameras.
        near: depths in metres from which others are tried.
        far: depths in metres up to which others are tried.
        steps: fractions of the way from near to far that are tried.
        tolerance: votes that an allowed depth may have.
        rays: indices of the masks' pixels; None: they are found.
        count: the masks have no more pixels than this; None: unknown.

    Returns:
        Near and far [B, V, h, w] in metres, half a step outside the depths that were tried.
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
    _marched,
    __name__,
    {"cpu": everything},
)
